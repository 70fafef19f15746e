"""Printed boards: the shapes in both files are the board's, in millimetres, and OpenCV finds it in them."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from board_pictures import raster

from calib.boards import Board
from calib.printing import Circle, Page, Rect, board_page, board_pdf, board_svg

PX_PER_MM = 4.0
CHESS = Board.of("chessboard", 9, 6, 0.02)
CHARUCO = Board.of("charuco", 6, 4, 0.03, marker_m=0.022, dictionary="DICT_5X5_100")
APRIL = Board.of("aprilgrid", 4, 3, 0.04, marker_m=0.03)
CIRCLES = Board.of("circles", 7, 5, 0.03)
ASYMMETRIC = Board.of("asymmetric-circles", 4, 11, 0.02)
BOARDS = pytest.mark.parametrize("board", [CHESS, CHARUCO, APRIL, CIRCLES, ASYMMETRIC], ids=str)


def page_of_svg(text: str) -> Page:
    """Rectangles and circles as the file has them."""
    root = ElementTree.fromstring(text)
    size = tuple(float(root.attrib[side].removesuffix("mm")) for side in ("width", "height"))
    assert [float(v) for v in root.attrib["viewBox"].split()] == [0, 0, *size]
    shapes: list[Rect | Circle] = []
    for item in root:
        number = {
            key: float(item.attrib[key])
            for key in ("x", "y", "width", "height", "cx", "cy", "r")
            if key in item.attrib
        }
        if item.tag.endswith("rect") and len(number) == 4:
            black = item.attrib.get("fill", "black") == "black"
            shapes.append(Rect(number["x"], number["y"], number["width"], number["height"], black))
        elif item.tag.endswith("circle"):
            shapes.append(Circle(number["cx"], number["cy"], number["r"]))
    return Page((size[0], size[1]), tuple(shapes), (0, 0))


def page_of_pdf(data: bytes) -> Page:
    """The same from the PDF's content: rectangles, and circles by their first and third points."""
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    stream = re.search(rb"/Length (\d+) >>\nstream\n(.*)\nendstream", data, re.DOTALL)
    assert box
    assert stream
    assert len(stream[2]) == int(stream[1])
    width, height = (float(side) / 72 * 25.4 for side in box.groups())
    flip, *lines = stream[2].decode().splitlines()
    a, b, c, d, e, f = (float(v) for v in flip.split()[:6])
    np.testing.assert_allclose([a, b, c, d, e, f], [72 / 25.4, 0, 0, -72 / 25.4, 0, float(box[2])], atol=1e-3)
    shapes: list[Rect | Circle] = []
    for line in lines:
        words = line.split()
        if words[-2:] == ["re", "f"]:
            x, y, w, h = (float(v) for v in words[2:6])
            shapes.append(Rect(x, y, w, h, words[0] == "0"))
        elif words[-1] == "f":
            right, left = float(words[2]), float(words[16])
            shapes.append(Circle((right + left) / 2, float(words[3]), (right - left) / 2))
    return Page((width, height), tuple(shapes), (0, 0))


@BOARDS
def test_both_files_hold_the_same_shapes(board: Board) -> None:
    ours, svg, pdf = board_page(board), page_of_svg(board_svg(board)), page_of_pdf(board_pdf(board))
    np.testing.assert_allclose(svg.size_wh_mm, ours.size_wh_mm, atol=1e-3)
    np.testing.assert_allclose(pdf.size_wh_mm, ours.size_wh_mm, atol=1e-3)
    assert np.array_equal(raster(svg, 3.0), raster(pdf, 3.0))


@BOARDS
def test_opencv_finds_the_board_in_the_file_where_it_must_be(board: Board) -> None:
    page = page_of_svg(board_svg(board))
    picture = cv2.GaussianBlur(raster(page, PX_PER_MM), (0, 0), 1.0)
    expected = (board.points_m[:, :2] * 1000 + board_page(board).first_mm) * PX_PER_MM - 0.5
    ids, uv = opencv_finds(board, np.asarray(picture, np.uint8))
    assert len(ids) == len(board.points_m)
    order = min(
        (expected[turn[ids]] for turn in board.symmetries()), key=lambda true: np.abs(true - uv).sum()
    )
    assert np.abs(uv - order).max() < 0.2


def opencv_finds(board: Board, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    all_ids = np.arange(len(board.points_m))
    if board.kind == "chessboard":
        there, uv = cv2.findChessboardCornersSB(picture, (board.cols, board.rows))
    elif board.kind == "charuco":
        codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        theirs = cv2.aruco.CharucoBoard((board.cols, board.rows), 0.03, 0.022, codes)
        uv, all_ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(picture)
        there = all_ids is not None
    elif board.kind == "aprilgrid":
        return tags(board, picture)
    else:
        flag = cv2.CALIB_CB_ASYMMETRIC_GRID if "asym" in board.kind else cv2.CALIB_CB_SYMMETRIC_GRID
        there, uv = cv2.findCirclesGrid(picture, (board.cols, board.rows), flags=flag)
    assert there
    return np.ravel(all_ids), np.asarray(uv, np.float64).reshape(-1, 2)


def tags(board: Board, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kalibr's layout: tag 0 at the bottom left, its OpenCV corner 0 at the tag's lower right."""
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = 2
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, numbers, _ = cv2.aruco.ArucoDetector(codes, options).detectMarkers(picture)
    ids, uv = [], []
    for number, four in zip(np.ravel(numbers), corners, strict=True):
        row, col = board.rows - 1 - number // board.cols, number % board.cols
        for k, (right, down) in enumerate(((1, 1), (0, 1), (0, 0), (1, 0))):
            ids.append((2 * row + down) * 2 * board.cols + 2 * col + right)
            uv.append(np.reshape(four, (4, 2))[k])
    fine = cv2.cornerSubPix(picture, np.array(uv, np.float32), (8, 8), (-1, -1), (3, 50, 0.001))
    return np.array(ids), fine.astype(np.float64)


@BOARDS
def test_ruler_and_caption(board: Board) -> None:
    svg, pdf = board_svg(board), board_pdf(board).decode("latin-1")
    page = board_page(board)
    lines = [s for s in page.shapes if isinstance(s, Rect) and abs(s.w - 100) < 1e-9 and s.h < 1]
    assert len(lines) == 1
    assert lines[0].x + 100 < page.size_wh_mm[0]
    for text in (svg, pdf):
        assert f"{board.kind} {board.cols}x{board.rows}" in text
        assert f"{board.spacing_m * 1000:g} mm" in text
        assert "100 mm" in text


@BOARDS
def test_all_is_on_the_page_with_a_white_rim(board: Board) -> None:
    page = board_page(board)
    picture = raster(page, 2.0)
    rim = 16
    assert (picture[:rim] == 255).all()
    assert (picture[:, :rim] == 255).all()
    assert (picture[:, -rim:] == 255).all()
    assert picture.min() == 0


def test_pdfs_table_points_at_its_objects() -> None:
    data = board_pdf(CIRCLES)
    start = int(re.search(rb"startxref\n(\d+)\n", data)[1])  # type: ignore[index]
    assert data[start:].startswith(b"xref\n0 6\n")
    offsets = [int(row[:10]) for row in data[start:].splitlines()[3:8]]
    assert all(data[at:].startswith(b"%d 0 obj" % k) for k, at in enumerate(offsets, 1))


def test_hidden_circles_and_tags_are_left_out() -> None:
    less = Board.of("circles", 7, 5, 0.03, hidden=[[0, 0, 2, 1]])
    count = [sum(isinstance(s, Circle) for s in board_page(b).shapes) for b in (CIRCLES, less)]
    assert count == [35, 33]
    assert len(
        board_page(Board.of("aprilgrid", 4, 3, 0.04, marker_m=0.03, hidden=[[0, 0, 2, 2]])).shapes
    ) < len(board_page(APRIL).shapes)
