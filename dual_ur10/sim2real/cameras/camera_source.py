"""Interface of a camera, and the kinds of cameras that a cell file names."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DualUR10Error, LinkError, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import CameraEntry, OwnCameraEntry, keywords_of
from ur_core.mjcf.camera import Camera
from ur_core.objects import load_object
from ur_core.processes.system import LOCAL, System
from ur_core.types import Closing

KINDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "file": "dual_ur10.sim2real.cameras.video_camera:FileCamera",
        "pattern": "dual_ur10.sim2real.cameras.pattern_camera:PatternCamera",
        "emulated": "dual_ur10.emulated.emulated_camera:EmulatedCamera",
        "v4l2": "dual_ur10.sim2real.cameras.video_camera:V4l2Camera",
    }
)
"""Classes by the kinds of a cell file. One of your own is named there itself."""


class Exposure(NamedTuple):
    """Image of a camera.

    Attributes:
        image: (height, width, 3) uint8, red, green and blue.
        exposed_s: Time of its exposure on the system's clock.
    """

    image: NDArray[np.uint8]
    exposed_s: float


@dataclass(frozen=True, kw_only=True)
class CameraRequest:
    """Request for a camera.

    Attributes:
        entry: Its table in the cell file.
        file: The cell file.
        size: Height and width of the images that are wanted. A camera whose own images have another size gives those.
        views: Cameras that the program added to the scene.
        observed: False: its images are recorded only, at their own size.
        system: Clock and network of the camera's process.
    """

    entry: CameraEntry
    file: CellFile
    size: tuple[int, int]
    views: tuple[Camera, ...] = ()
    observed: bool = True
    system: System = LOCAL

    @property
    def kept(self) -> tuple[int, int]:
        """Height and width of the images in memory."""
        return self.size if self.observed else (1, 1)

    @property
    def where(self) -> str:
        """Name and kind of the camera, for messages."""
        return f"camera {self.entry.name} ({self.entry.kind})"


class CameraSource(Closing):
    """Source of images, made in a process of its own. One of your own is named in the cell file.

    It is made with a `CameraRequest`, and the options of the cell file as keywords.
    """

    @abstractmethod
    def read(self) -> Exposure:
        """Wait for the next image, and return it. It may wait as long as it takes: nothing waits for it.

        Raises:
            LinkError: The camera was lost, or there are no more images.
        """

    def close(self) -> None:
        """Release the camera: by default, there is nothing to release. May be called twice."""


def source_type(entry: CameraEntry) -> type[CameraSource]:
    """Return the class of a camera of a cell file.

    Raises:
        SettingsError: It cannot be imported, or is no camera.
    """
    own = isinstance(entry, OwnCameraEntry)
    path = entry.camera if isinstance(entry, OwnCameraEntry) else KINDS[entry.kind]
    found: Any = load_object(path, f"the camera {entry.name!r}", registered=not own)
    if not (isinstance(found, type) and issubclass(found, CameraSource)):
        raise SettingsError(f"{path!r}, the camera {entry.name!r}, is no subclass of {CameraSource.__qualname__}")
    return found


def source_of(request: CameraRequest) -> CameraSource:
    """Return the camera of a request.

    Raises:
        SettingsError: It cannot be made of the request and its options.
        LinkError: It cannot be reached.
    """
    entry = request.entry
    options = entry.options if isinstance(entry, OwnCameraEntry) else ""
    make: Any = source_type(entry)
    try:
        source: CameraSource = make(request, **keywords_of(options))
    except DualUR10Error:
        raise
    except TypeError as error:
        raise SettingsError(
            f"{request.where} cannot be made of a request and the options {options or '(none)'}: {error}"
        ) from error
    except Exception as error:  # of any kind: it may be another's code
        raise LinkError(f"{request.where}: {error!r}") from error
    return source
