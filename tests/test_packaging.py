import pathlib
import subprocess
import sys
import zipfile

import pytest

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=120, capture_output=True)
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_holds_the_package_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"dual_ur10"}
    packages = {name.split("/")[1] for name in names if name.startswith("dual_ur10/") and name.count("/") == 2}
    assert {each for each in packages if f"dual_ur10/{each}/__init__.py" in names} == {
        "assets",
        "comparison",
        "envs",
        "policies",
        "recording",
        "sim2real",
        "training",
    }
    assert "dual_ur10/assets/ur10/ur10.xml" in names
    assert "dual_ur10/policies/learned_policies/sine_tracking/policy.safetensors" in names
    assert "dual_ur10/py.typed" in names


def test_the_installed_wheel_works(wheel, tmp_path):
    target = tmp_path / "site"
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--target",
        str(target),
        str(wheel),
    ]
    subprocess.run(install, check=True, timeout=120, capture_output=True)
    code = (
        "import pathlib, dual_ur10\n"
        "import dual_ur10.assets.scene, dual_ur10.envs.core, dual_ur10.policies, dual_ur10.sim2real.gate\n"
        f"assert pathlib.Path(dual_ur10.__file__).is_relative_to({str(target)!r})\n"
        "import gymnasium\n"
        "env = gymnasium.make('DualUR10/SineTracking-v0')\n"
        "env.reset(seed=0)\n"
        "env.step(env.action_space.sample())\n"
        "from importlib.metadata import version\n"
        "assert dual_ur10.__version__ == version('dual-ur10')\n"
    )
    environment = {"PYTHONPATH": str(target), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, cwd=tmp_path, env=environment)


def test_readme_and_module_say_the_same_version():
    import dual_ur10

    assert f"version: {dual_ur10.__version__}" in (ROOT / "CITATION.cff").read_text()


def test_imports_run_downwards():
    floors = [
        ["ur10", "errors", "files", "loading", "registration", "rotations", "versions"],
        ["assets", "kinematics", "dynamics"],
        ["frames"],
        ["sim2real"],
        ["recording"],
        ["envs"],
        ["policies"],
        ["training"],
        ["emulator"],
    ]
    floors += [["runs"], ["runs_carry", "runs_handover"], ["figures_style"]]
    floors += [["figures", "figures_carry", "figures_handover"], ["film"], ["films"], ["report_page"]]
    floors += [
        ["report_sine", "report_carry", "report_handover"],
        ["comparison"],
        ["runs_emulated"],
        ["figures_emulated"],
        ["report_emulated"],
        ["report"],
        ["testing"],
        ["demo"],
        ["cli_options"],
    ]
    floors += [
        ["cli_cell", "cli_convert", "cli_demo", "cli_doctor", "cli_emulate", "cli_evaluate"],
        ["cli_runs", "cli_status", "cli_train"],
        ["cli"],
        ["__main__"],
    ]
    level = {name: height for height, names in enumerate(floors) for name in names}
    level |= dict.fromkeys(("forward_kinematics", "inverse_kinematics", "closed_form"), level["kinematics"])
    for path in (ROOT / "dual_ur10").rglob("*.py"):
        here = path.relative_to(ROOT / "dual_ur10").parts[0].removesuffix(".py")
        if here == "__init__":
            continue
        for line in path.read_text().splitlines():
            words = line.split()
            if len(words) > 1 and words[0] in ("from", "import") and words[1].startswith("dual_ur10."):
                there = words[1].split(".")[1]
                assert level[there] <= level[here], f"{path.name}: {line.strip()}"


def test_the_readmes_code_runs():
    import re

    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) >= 4
    subprocess.run([sys.executable, "-c", "\n".join(blocks)], check=True, timeout=120, cwd=ROOT)
