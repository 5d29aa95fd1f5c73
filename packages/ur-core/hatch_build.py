"""Build hook: compile the control kernel, `ur_core/kernel`, into the package.

Run as a script, it compiles the kernel of this checkout in place. The compiler is `$CXX`, else `c++`, `g++` or
`clang++`; where there is none, pip brings Zig's as a build requirement. The kernel needs no Python headers and no C++
runtime, so one wheel serves all Python versions of a platform.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

ZIG = "ziglang>=0.13"
KERNEL = Path("ur_core", "kernel")
LIBRARY = "_kernel.so"

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ModuleNotFoundError:  # as a script
    BuildHookInterface = object


def compiler() -> list[str] | None:
    """Return the command of a C++ compiler; None where pip has to bring one."""
    if os.environ.get("CXX"):
        return shlex.split(os.environ["CXX"])
    for name in ("c++", "g++", "clang++"):
        # macOS has programs of these names that only ask to install a compiler.
        if (found := shutil.which(name)) and subprocess.run([found, "--version"], capture_output=True).returncode == 0:
            return [found]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "c++", "-nostdlib++", "-mcpu=baseline"]  # not for this processor alone
    return None


def sources_hash(folder: Path) -> str:
    """Return the hash of the sources and flags, as `ur_core.kernel.sources_hash` does."""
    digest = hashlib.sha256()
    for path in sorted([*folder.glob("*.?pp"), folder / "flags.txt"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def build(root: Path, *more: str) -> Path:
    """Compile the kernel of a checkout in place, with more flags than its own, and return the library."""
    folder = root / KERNEL
    library, command = folder / LIBRARY, compiler()
    if command is None:
        sys.exit(f"no C++ compiler was found: install one (on Debian: g++), or `pip install '{ZIG}'`, and try again")
    unfinished = library.with_suffix(f".{os.getpid()}")
    define = f'-DKERNEL_SOURCES="{sources_hash(folder)}"'
    flags = [*(folder / "flags.txt").read_text().split(), *more, define]
    try:
        done = subprocess.run([*command, *flags, str(folder / "kernel.cpp"), "-o", str(unfinished), "-lm"])
    except FileNotFoundError:
        sys.exit(f"there is no compiler {command[0]!r}: correct the environment variable CXX, or unset it")
    if done.returncode:
        sys.exit(f"the control kernel could not be compiled with {shlex.join(command)}: see its messages above")
    unfinished.replace(library)  # a process that has loaded the former one keeps it
    return library


class CustomBuildHook(BuildHookInterface):  # type: ignore[misc]
    """Compiles the kernel for wheels and editable installations."""

    def dependencies(self) -> list[str]:
        """Return the build requirements beside hatchling: a compiler, where there is none."""
        return [] if self.target_name == "sdist" or compiler() else [ZIG]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and mark the wheel as one of this platform and any Python 3."""
        if self.target_name != "wheel":
            return
        system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        if sys.platform == "darwin":  # this processor alone, also where Python itself is for both kinds
            system = f"macosx_11_0_{platform.machine()}"
            build(Path(self.root), "-mmacosx-version-min=11.0")
        else:
            build(Path(self.root))
        build_data.update(pure_python=False, tag=f"py3-none-{system}")
        build_data["artifacts"].append(f"{KERNEL.as_posix()}/{LIBRARY}")


if __name__ == "__main__":
    build(Path(__file__).parent, "-Werror")
