"""How MuJoCo is to draw without a screen: on the GPU where there is one, otherwise in Mesa's software."""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library

from romnav.errors import RomnavError

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""Values of MUJOCO_GL that need no screen, and the library of each."""
FIX = "install Mesa (Debian: apt-get install libegl1 libgl1-mesa-dri, or libosmesa6)"


def choose() -> None:
    """Sets MUJOCO_GL unless the user has; MuJoCo reads it once, when it is imported.

    Raises:
        RomnavError: There is no library to draw with.
    """
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL"):
        return
    found = [name for name, library in LIBRARIES.items() if find_library(library)]
    if not found:
        raise RomnavError(f"no OpenGL to draw with, neither EGL nor OSMesa; {FIX}")
    os.environ["MUJOCO_GL"] = found[0]
