"""Run by an environment that holds only the built wheel: what was shipped, and does it work?"""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path


def main(dist: Path) -> None:
    (wheel,) = dist.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert top == {"fusion", "calib"}, f"the wheel's top level is {sorted(top)}"
    manifests = [name for name in names if name.startswith("fusion/manifests/")]
    assert any(name.endswith(".toml") for name in manifests), "no manifests in the wheel"
    assert not any(name.endswith(".py") for name in manifests), "Python among the manifests"

    import fusion
    from fusion.manifest import list_manifests

    assert "site-packages" in fusion.__file__, f"not the installed one: {fusion.__file__}"
    print(f"{wheel.name}: {len(names)} files, data sets {', '.join(m.name for m in list_manifests())}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
