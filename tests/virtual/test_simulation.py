"""Fault simulator: schedules from seeds and files, its invariants, and seeds that hold them."""

from collections import Counter

import pytest

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.runtime.arm_sender import ArmSender
from dual_ur10.sim2real.runtime.latch import Latch
from tests.soak import SOAK
from tests.virtual import simulate
from tests.virtual.schedule import _KINDS, Safety, Schedule, Slider, draw, load, text
from tests.virtual.simulation import run

STOP = Schedule(faults=(Safety(arm="left", mode=3),))


def quick(seed):
    """Return True for a schedule whose cell is quick to simulate."""
    cell = draw(seed).cell
    return cell.task == "SineTracking" and cell.family == "cb3" and not (cell.far or cell.again)


def several(seeds, times):
    """Yield the seeds that each bring a fault of a kind which fewer than so many before them had."""
    seen = Counter()
    for seed in seeds:
        kinds = {fault.kind for fault in draw(seed).faults}
        if any(seen[kind] < times for kind in kinds):
            seen.update(kinds)
            yield seed


QUICK = [seed for seed in range(200) if quick(seed)][:100]
SEEDS = QUICK if SOAK else [*several(QUICK, 1)]


@pytest.mark.parametrize("first", range(0, len(SEEDS), 10))
def test_no_seed_breaks_an_invariant(first):
    found = {seed: run(draw(seed)).violations for seed in SEEDS[first : first + 10]}
    assert not any(found.values()), {seed: each for seed, each in found.items() if each}


def test_a_seed_is_a_single_fault_or_a_pair():
    assert [len(draw(seed).faults) for seed in range(4)] == [1, 2, 1, 2]


def test_the_tested_seeds_have_faults_of_every_kind():
    assert {fault.kind for seed in SEEDS for fault in draw(seed).faults} == _KINDS.keys()


def test_a_run_is_the_same_each_time():
    first, second = run(STOP), run(STOP)
    assert "left" in first.latched
    first.cpu_s = second.cpu_s = 0.0
    assert first == second


def test_schedules_survive_their_files(tmp_path):
    path, again = tmp_path / "schedule.toml", tmp_path / "schedule.json"
    for seed in range(40):
        path.write_text(text(draw(seed)))
        assert load(path) == draw(seed)
        again.write_text(draw(seed).model_dump_json(indent=1))
        assert load(again) == draw(seed)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("seed = 1\n\n[cell]\nfamily = 'cb4'\n", ["line 4", "cell.family", "cb4"]),
        ("[cell]\nmotion = 1.0\n", ["line 2", "cell.motion"]),
        ("[[faults]]\nkind = 'second'\n[[faults]]\nkind = 'safety'\narm = 'left'\nmode = 300\n",
         ["line 6", "faults.1.mode", "300"]),
        ("[[faults]]\nkind = 'slide'\n", ["line 1", "faults.0"]),
        ("[[faults]\n", ["line 1"]),
        ("seed = -1\n", ["line 1", "seed"]),
    ],
)  # fmt: skip
def test_a_malformed_file_is_refused_with_line_and_field(tmp_path, content, words):
    path = tmp_path / "schedule.toml"
    path.write_text(content)
    with pytest.raises(SettingsError) as found:
        load(path)
    assert all(word in str(found.value) for word in words), str(found.value)


def test_a_file_that_is_not_json_is_refused_with_its_line(tmp_path):
    path = tmp_path / "schedule.json"
    path.write_text('{\n "seed": 1,\n}')
    with pytest.raises(SettingsError, match="line 3"):
        load(path)


def test_a_missing_latch_is_a_violation(monkeypatch):
    monkeypatch.setattr(Latch, "set", lambda self, text: None)
    assert "latched" in run(STOP).violations[0]


def test_a_sender_that_continues_is_a_violation(monkeypatch):
    monkeypatch.setattr(ArmSender, "_check_others", lambda self, now: None)
    assert any("led on" in each for each in run(STOP).violations)


def test_a_failing_schedule_is_shrunk_to_its_cause(monkeypatch):
    monkeypatch.setattr(Latch, "set", lambda self, text: None)
    schedule = STOP.model_copy(update={"faults": (Slider(arm="right", fraction=0.5), *STOP.faults)})
    assert simulate.shrink(schedule, most=4).faults == STOP.faults


def test_the_command_line_replays_a_seed(capsys):
    assert simulate.main(["--seed", str(SEEDS[0])]) == 0
    assert "violations: []" in capsys.readouterr().out


def test_the_command_line_prints_a_line_that_replays(capsys, monkeypatch):
    monkeypatch.setattr(simulate, "run", lambda schedule: simulate.Outcome(["broken"]))
    assert simulate.main(["--seeds", "7:9", "--jobs", "1", "--no-shrink"]) == 1
    assert "make simulate SEED=7" in capsys.readouterr().out


def test_the_command_line_refuses_a_malformed_file(tmp_path, capsys):
    path = tmp_path / "schedule.toml"
    path.write_text("[cell]\nseed = 'one'\n")
    assert simulate.main(["--schedule", str(path)]) == 2
    assert "cell.seed" in capsys.readouterr().err
