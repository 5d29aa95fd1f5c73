"""The live page in a real browser: buttons by their names, handles dragged with the mouse.

Nothing here waits for a time to pass: each step waits for what it is to bring about, at most `SOON_S`, because two
pages without a GPU on a busy machine take long.
"""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

from dual_ur10.envs.rendering.live.overlay import Overlay
from dual_ur10.errors import CellFaulted
from dual_ur10.sim2real.runtime.arm_memory import Phase
from dual_ur10.testing import VirtualCell
from tests.browser.live import Live, on_screen
from tests.waiting import until
from ur_core.kinematics.rotations import quat_to_matrix

CHROMIUM = os.environ.get("CHROMIUM")
if CHROMIUM is None:
    pytest.skip("make test-page runs these", allow_module_level=True)
sync_api = pytest.importorskip("playwright.sync_api", reason="make test-page installs playwright")

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE = {"width": 900, "height": 500}  # small, since it is drawn without a GPU
TINY = {"width": 500, "height": 300}
SOON_S = 120.0
GRAB_S = 5.0
GRABS = 10
OVERLAID = Overlay(stops=True).over(b"<html><body></body></html>")
FRAMES = "() => new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))"


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS, timeout=1e3 * SOON_S)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def shared():
    live = Live({})
    yield live
    live.close()


@pytest.fixture
def live(shared):
    """Page that nobody has open: one that opens commands."""
    until(lambda: not shared.page.memory.pages, SOON_S)
    return shared


@pytest.fixture
def new_page(browser):
    contexts = []

    def opened(url, size=SIZE):
        contexts.append(browser.new_context(viewport=size))
        page = contexts[-1].new_page()
        page.set_default_timeout(1e3 * SOON_S)
        page.goto(url)
        page.get_by_role("button", name="STOP BOTH ARMS").wait_for()
        return page

    yield opened
    for each in contexts:
        each.close()


def _press(page, name):
    """Press a button once it stands still, is in sight, and nothing covers it."""
    page.get_by_role("button", name=name, exact=True).click()


def _begin(live, page):
    """Begin an episode from the page that commands. A line that is new in its panel may move the button meanwhile."""
    before = live.session.shown.episode
    until(lambda: live.page.memory.pages >= 1, SOON_S)
    for left in reversed(range(GRABS)):
        _press(page, "Reset")
        try:
            # The operator knows the tools from the first action of the episode on.
            until(lambda: live.session.shown.episode > before and live.operator.tools_m.any(), GRAB_S)
            return
        except AssertionError:
            if not left:
                raise


def _grab(live, page, arm):
    """Grab the tip of the arrow along the tool's axis, and return the pose of the tool and where its ways are shown.

    A page that has not drawn the handle yet does not feel the mouse: it is pressed again.
    """
    tool = live.operator.tools_m[arm].copy()
    axis = quat_to_matrix(tool[3:])[:, 2]
    tip = on_screen(tool[:3] + 0.25 * axis, **SIZE)
    for _ in range(GRABS):
        page.mouse.move(tip[0] + 2, tip[1])
        page.mouse.move(*tip)
        page.evaluate(FRAMES)
        page.mouse.down()
        try:
            until(lambda: live.page.handles().clutch[arm], GRAB_S)
        except AssertionError:
            page.mouse.up()
        else:
            return tool, lambda way_m: on_screen(tool[:3] + (0.25 - way_m) * axis, **SIZE)
    raise AssertionError(f"the handle was not grabbed at {tip} in {GRABS} tries")


def test_a_dragged_handle_moves_the_commanded_tool(live, new_page):
    page = new_page(live.url)
    _begin(live, page)
    tool, at = _grab(live, page, 0)
    for way_m in (0.03, 0.07, 0.1):
        page.mouse.move(*at(way_m))
    until(lambda: live.operator.tools_m[0, 2] > tool[2] + 0.05, SOON_S)
    assert live.page.handles().clutch.tolist() == [True, False]
    page.mouse.up()
    until(lambda: not live.page.handles().clutch.any(), SOON_S)
    np.testing.assert_allclose(live.operator.tools_m[0, :2], tool[:2], atol=0.01)


def test_a_button_of_a_group_sets_the_speed(live, new_page):
    page = new_page(live.url)
    _begin(live, page)
    _press(page, "0.5×")
    page.get_by_text("0.5× speed").wait_for()
    _press(page, "overhead")
    _press(page, "1×")
    page.get_by_text("0.5× speed").wait_for(state="detached")


def test_a_closed_page_releases_its_handle(live, new_page):
    page = new_page(live.url)
    _begin(live, page)
    _grab(live, page, 1)
    page.context.close()
    until(lambda: not live.page.handles().clutch.any(), SOON_S)


def test_a_second_page_watches_and_may_stop(live, new_page):
    first = new_page(live.url, TINY)
    _begin(live, first)
    second = new_page(live.url, TINY)
    until(lambda: live.page.memory.pages == 2, SOON_S)
    episode = live.session.shown.episode
    _press(second, "Reset")
    second.get_by_text("This page watches").first.wait_for()
    assert live.session.shown.episode == episode
    _press(second, "STOP BOTH ARMS")
    first.get_by_text("STOPPED by the page").wait_for()
    _press(first, "Leave the controls")
    _press(second, "Take the controls")
    _begin(live, second)
    second.get_by_text("STOPPED by the page").wait_for(state="detached")


@pytest.mark.parametrize(("width", "height"), [(1100, 760), (400, 400)])
def test_the_stop_is_in_sight_wherever_the_panel_is_scrolled_and_nothing_is_too_wide(live, new_page, width, height):
    page = new_page(live.url, {"width": width, "height": height})
    stop = page.get_by_role("button", name="STOP BOTH ARMS")
    for name in ("Take left", "Hand back", "Take the controls"):
        button = page.get_by_role("button", name=name, exact=True)
        button.scroll_into_view_if_needed()
        for each in (button, stop):
            box = each.bounding_box()
            assert 0 <= box["x"] <= box["x"] + box["width"] <= width
        assert 0 <= box["y"] <= box["y"] + box["height"] <= height
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        assert stop.evaluate("(it, at) => it.contains(document.elementFromPoint(...at))", middle)  # nothing covers it
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_space_bar_stops_whatever_has_the_focus_but_a_text_field(live, new_page):
    page = new_page(live.url, TINY)
    _begin(live, page)
    memory = live.page.memory
    stops, (_, since) = memory.stops, memory.pressed(0)
    page.evaluate("document.body.appendChild(document.createElement('input')).focus()")
    page.keyboard.type(" r 1 ")
    page.evaluate("document.activeElement.remove()")
    page.get_by_role("button", name="Take both", exact=True).focus()
    page.keyboard.press("Space")
    page.get_by_text("STOPPED by the page").wait_for()
    assert (memory.stops, memory.pressed(since)[0]) == (stops + 1, [])
    page.keyboard.press("r")
    page.get_by_text("STOPPED by the page").wait_for(state="detached")
    page.keyboard.press("1")
    until(lambda: memory.pressed(since)[0] == ["reset", "take_left"], SOON_S)


@pytest.mark.parametrize("refusal", [None, 500])
def test_the_stop_says_so_while_the_program_does_not_answer(browser, refusal):
    answers = [refusal, 200]
    context = browser.new_context(viewport=TINY)
    page = context.new_page()

    def answer(route):
        status = answers.pop(0)
        route.abort() if status is None else route.fulfill(status=status)

    page.route("http://overlay.test/", lambda route: route.fulfill(body=OVERLAID, content_type="text/html"))
    page.route("http://overlay.test/stop", answer)
    page.goto("http://overlay.test/")
    stop = page.locator("#stop-both-arms")
    for text in ("NOT STOPPED: ", "STOP BOTH ARMS"):
        stop.click()
        sync_api.expect(stop).to_contain_text(text, timeout=1e3 * GRAB_S)
    assert answers == []
    context.close()


def test_a_page_loads_nothing_from_elsewhere(live, browser):
    context = browser.new_context(viewport=TINY)
    asked = []
    page = context.new_page()
    page.on("request", lambda request: asked.append(request.url))
    page.goto(live.url, timeout=1e3 * SOON_S)
    page.get_by_role("button", name="STOP BOTH ARMS").wait_for(timeout=1e3 * SOON_S)
    own = live.url.split("?")[0]
    assert [
        each for each in asked if not each.startswith((own, "data:", f"blob:{own}", own.replace("http", "ws")))
    ] == []
    context.close()


def _step(env, count):
    for _ in range(count):
        env.step(np.zeros(env.action_space.shape, np.float32))


def test_the_button_stops_both_arms_of_controllers(new_page):
    """On a virtual clock: the page itself latches the stop, in the memory that the cell's processes share."""
    with VirtualCell() as cell:
        live = Live({"cell": cell}, task="SineTracking", policy="scripted", threaded=False)
        try:
            page = new_page(live.url, TINY)
            until(lambda: live.page.memory.pages == 1, SOON_S)
            live.session.begin(0)
            live.session.turn()
            page.get_by_text("streaming").first.wait_for()
            fault = live.core.cell.runner.cell
            _press(page, "STOP BOTH ARMS")
            until(lambda: fault.fault, SOON_S)
            assert "live page" in fault.fault
            with pytest.raises(CellFaulted, match="live page"):
                _step(live.env, 50)
            cell.clock.sleep(2.0)
            assert all(arm.phase >= Phase.STOPPED for arm in live.core.cell.runner.arms)
            page.get_by_text("LATCHED").first.wait_for()
        finally:
            live.close()


def test_both_arms_of_controllers_stop_once_the_last_page_is_closed(new_page):
    with VirtualCell() as cell:
        live = Live({"cell": cell}, task="SineTracking", policy="scripted", threaded=False)
        try:
            page = new_page(live.url, TINY)
            # A page shows its buttons before it is connected, and arms that nobody watches stop after 3 s.
            until(lambda: live.page.memory.pages == 1, SOON_S)
            live.session.begin(0)
            live.session.turn()
            page.get_by_text("streaming").first.wait_for()
            fault = live.core.cell.runner.cell
            assert not fault.fault
            page.context.close()
            until(lambda: fault.fault, SOON_S)
            assert "no live page has been open" in fault.fault
        finally:
            live.close()


def test_a_rollout_begins_once_its_page_is_open_and_ends_with_its_process(browser):
    arguments = ["rollout", "SineTracking", "-n", "1", "--no-record", "--set", "duration_s=0.4"]
    command = [sys.executable, "-m", "dual_ur10", *arguments, "--operator", "page:port=0,cameras=none"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        try:
            lines = iter(program.stdout.readline, "")
            url = next(filter(None, (re.search(r"http://\S+", line) for line in lines)))[0]
            context = browser.new_context(viewport=TINY)
            page = context.new_page()
            page.goto(url, timeout=1e3 * SOON_S)
            page.get_by_role("button", name="Take the controls").wait_for(timeout=1e3 * SOON_S)
            assert "success" in program.communicate(timeout=SOON_S)[0]
            assert program.returncode == 0
            context.close()
        finally:
            program.kill()
