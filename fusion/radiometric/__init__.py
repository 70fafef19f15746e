"""Files of thermal cameras that hold the sensor's counts and what turns them into degrees."""

from fusion.radiometric.block import PictureInPicture
from fusion.radiometric.flir import FlirImage, read_flir
from fusion.radiometric.planck import Planck

__all__ = ["FlirImage", "PictureInPicture", "Planck", "read_flir"]
