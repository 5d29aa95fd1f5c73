"""Garbage of episodes: freed, without a collection of the whole program."""

from __future__ import annotations

import gc
import weakref

import pytest

from ur_core.processes.garbage import MOST_OBJECTS, GarbageCollector


class Episode:
    """Object in a cycle, as an exception with its traceback is."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def collector():
    made = GarbageCollector()
    yield made
    made.release()
    assert gc.get_freeze_count() == 0


@pytest.fixture
def collections(monkeypatch):
    """Return the list of full collections that the program asks for."""
    asked = []
    collect = gc.collect
    monkeypatch.setattr(gc, "collect", lambda *_: asked.append(collect()))
    return asked


def test_what_an_episode_leaves_is_freed(collector):
    collector.prepare_episode()
    frozen = gc.get_freeze_count()
    left = []
    for _ in range(20):
        episode = Episode()
        left.append(weakref.ref(episode))
        collector.prepare_episode()  # it lives: the caller holds the last episode while it begins the next
    assert [each() for each in left[:-1]] == [None] * 19
    assert left[-1]() is episode
    assert gc.get_freeze_count() <= frozen


def test_the_program_of_before_the_first_episode_is_never_collected(collector, collections):
    before = Episode()
    found = weakref.ref(before)
    collector.prepare_episode()
    assert collections == []
    del before
    collector.prepare_episode()
    assert len(collections) == 1
    assert found() is not None


def test_many_new_objects_are_frozen_and_not_collected(collector, collections):
    collector.prepare_episode()
    kept = [[] for _ in range(MOST_OBJECTS)]
    collector.prepare_episode()
    assert collections == []
    assert not {id(each) for each in gc.get_objects()} & {id(each) for each in kept}  # it lists none that is frozen
    collector.prepare_episode()
    assert len(collections) == 1


def test_a_released_collector_freezes_again(collector):
    collector.prepare_episode()
    collector.release()
    assert gc.get_freeze_count() == 0
    collector.prepare_episode()
    assert gc.get_freeze_count() > 0
