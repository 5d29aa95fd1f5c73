"""Cost of the live page: time to the first picture, its process's load, and late periods of a streaming cell.

Periods of a scripted policy on two emulated controllers, interleaved: stretches without a page, and with a page and two
viewers. A viewer is a client that receives all that a browser would, without drawing it. The first picture is there
when a viewer has received the whole scene.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import re
import subprocess
import sys
import tempfile
import time
import urllib.parse
from pathlib import Path

import numpy as np

from dual_ur10.cli.session import make
from dual_ur10.envs.rendering.live.shown import Shown
from dual_ur10.errors import CellFaulted
from dual_ur10.policies.operators.page import open_page
from dual_ur10.testing import CellForTests

LATE_S = 0.002
VIEWERS = 2
BULK = 50_000  # bytes: the scene is more than this; later messages are smaller than a tenth of it


async def receive(url, enough):
    """Receive what a browser would until it is `enough`, by the bytes so far and those of the newest message."""
    import msgspec
    import viser
    from viser import _messages
    from websockets.asyncio.client import connect

    parts = urllib.parse.urlsplit(url)
    token = urllib.parse.parse_qs(parts.query)["token"][0]
    async with connect(
        f"ws://{parts.netloc}",
        origin=f"http://{parts.netloc}",
        additional_headers={"Cookie": f"dual_ur10_live_{parts.port}={token}"},
        subprotocols=[f"viser-v{viser.__version__}"],
        compression=None,
        max_size=None,
    ) as connection:
        camera = _messages.ViewerCameraMessage(
            wxyz=(1.0, 0.0, 0.0, 0.0),
            position=(2.0, 2.0, 2.0),
            fov=0.8,
            near=0.01,
            far=100.0,
            image_height=600,
            image_width=800,
            look_at=(0.0, 0.0, 0.0),
            up_direction=(0.0, 0.0, 1.0),
        )
        await connection.send(msgspec.msgpack.encode(camera.as_serializable_dict()))
        received = newest = 0
        while not enough(received, newest):
            with contextlib.suppress(TimeoutError):
                newest = len(await asyncio.wait_for(connection.recv(), 0.5))
                received += newest


def viewer(url, over):
    """Receive what a browser would until `over` is set."""
    asyncio.run(receive(url, lambda *_: over.is_set()))


def first_picture_s():
    """Return the times from the command until its page answers, and until a viewer has all that it is to draw."""
    begun = time.monotonic()
    command = [sys.executable, "-m", "dual_ur10", "live", "Handover", "--policy", "scripted", "--port", "0"]
    process = subprocess.Popen([*command, "--cameras", "none"], stdout=subprocess.PIPE, text=True)
    try:
        url = next((found[0] for line in process.stdout if (found := re.search(r"http://\S+", line))), None)
        if url is None:
            raise SystemExit("the page did not start")
        ready_s = time.monotonic() - begun
        asyncio.run(receive(url, lambda received, newest: received > BULK > 10 * newest))
        return ready_s, time.monotonic() - begun
    finally:
        process.terminate()
        process.wait(20)


def cpu_s(pid):
    """Return the processor time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def watched_by(setup, count):
    """Give a page with viewers in processes of their own."""
    context = multiprocessing.get_context("spawn")
    page, over = open_page(setup, ("stop",), port=0, cameras="none", unattended=True), context.Event()
    clients = []
    try:
        url = page.wait_until_ready()
        clients += [context.Process(target=viewer, args=(url, over)) for _ in range(count)]
        for each in clients:
            each.start()
        end_s = time.monotonic() + 60.0
        while page.memory.pages < count:
            if time.monotonic() > end_s:
                raise SystemExit("the viewers did not connect")
            time.sleep(0.1)
        yield page
    finally:
        over.set()
        for each in clients:
            each.join(20)
        page.close()


def stretch(env, policy, seconds, *, first):
    """Return late and all periods of both senders while a policy acts for some seconds."""
    core = env.unwrapped.core
    observation, _ = env.reset(seed=0, options=None if first else {"move_to_start": True})
    policy.reset()
    arms = core.cell.runner.arms
    seen, begun, over = [arm.sent_count for arm in arms], time.monotonic(), False
    while time.monotonic() < begun + seconds and not over:
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        over = terminated or truncated
    core.finish()  # both arms stop along their brake, and no action is owed
    late = [arm.sent(since)[0].late_s for arm, since in zip(arms, seen, strict=True)]
    return sum(int(np.count_nonzero(each > LATE_S)) for each in late), sum(map(len, late))


def late_periods(seconds, stretches):
    """Return late and all periods without and with a page, the page's share of a core, and stretches given up.

    A pair of which one was given up, because the machine was too busy to move arms at all, is repeated on a new cell.
    """
    found, shares, given_up = {False: [], True: []}, [], {False: 0, True: 0}
    while len(shares) < stretches and sum(given_up.values()) < stretches:
        with tempfile.TemporaryDirectory() as folder, CellForTests(Path(folder), task="SineTracking") as cell:
            env, policy = make("SineTracking", "scripted", {"cell": str(cell.path)}, 0)
            watched = False
            try:
                first = True
                while len(shares) < stretches:
                    watched = False
                    without = stretch(env, policy, seconds, first=first)
                    first, watched = False, True
                    with watched_by(env.unwrapped.core.setup, VIEWERS) as page:
                        used_s, begun = cpu_s(page.pid), time.monotonic()
                        beside = stretch(Shown(env, page), policy, seconds, first=False)
                        shares.append((cpu_s(page.pid) - used_s) / (time.monotonic() - begun))
                    found[False].append(without)
                    found[True].append(beside)
                    print(f"late without {without}, with {beside}, {load()}", flush=True)
            except CellFaulted as error:
                given_up[watched] += 1
                print(f"{'with' if watched else 'without'} a page, {load()}: {error}", flush=True)
            finally:
                env.close()
    if not shares:
        raise SystemExit("the machine is too busy for two streaming arms")
    return found, float(np.mean(shares)), [given_up[False], given_up[True]]


def load():
    """Return the load of the machine in words."""
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def figures_of(seconds, stretches):
    """Measure and return the figures."""
    first_picture_s()  # compiles what is imported
    starts = [first_picture_s() for _ in range(3)]
    print("address and first picture, s", [tuple(round(each, 2) for each in start) for start in starts], load())
    found, share, given_up = late_periods(seconds, stretches)
    (late, periods), (late_watched, watched) = (np.sum(found[each], axis=0).tolist() for each in (False, True))
    return {
        "page_address_s": round(min(ready for ready, _ in starts), 2),
        "page_first_picture_s": round(min(picture for _, picture in starts), 2),
        "page_core_share": round(share, 3),
        "page_periods": [periods, watched],
        "page_late": [late, late_watched],
        "page_late_extra": round(late_watched / max(1, watched) - late / max(1, periods), 5),
        "page_stretches_given_up": given_up,
        "page_load": load(),
    }


def main():
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a stretch")
    parser.add_argument("--stretches", type=int, default=6, help="stretches with a page, and as many without")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    figures = figures_of(options.seconds, options.stretches)
    for name, value in figures.items():
        print(f"{name:20} {value}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
