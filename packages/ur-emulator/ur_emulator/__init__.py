"""Emulated UR controllers, their ports, and the MuJoCo simulation of their arms.

    with EmulatedController("ur5e") as controller:
        rtde = rtde_receive.RTDEReceiveInterface(controller.host)

Rooms, from the lowest up: `script` (URScript) and `motion` (reference motion) do not depend on a controller.
`controller` runs one control period with the `builtins`. `ports` serve it where UR's controllers listen, and
`injection` injects faults. `emulator` advances arms together with their `world`, and `emulated_controller` starts all
of it in a separate process. `virtual` runs it on a virtual clock, in the process of its user. Cells, tasks and
environments are never known here.
"""

import ur_core
from ur_core.errors import MixedVersionsError

__version__ = "0.1.0"

if ur_core.__version__ != __version__:
    raise MixedVersionsError("ur-emulator", __version__, "ur-core", ur_core.__version__)
