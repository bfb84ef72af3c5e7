"""Threads that do the same at once: each in one of its own, stopped by each other's exceptions."""

import threading

import pytest

from striptools.threads import at_once


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_each_is_done_once_in_a_thread_of_its_own(count):
    done, together = {}, threading.Barrier(max(1, count))

    def work(k, stopped):
        together.wait(60)
        assert not stopped.is_set()
        done[k] = threading.get_ident()

    at_once(work, count)
    assert sorted(done) == list(range(count))
    assert len(set(done.values())) == count
    assert (threading.get_ident() in done.values()) == (count == 1)


@pytest.mark.parametrize("failing", [{0}, {2}, {1, 2}])
def test_what_was_raised_is_raised_once_all_have_stopped(failing):
    ended, together = [], threading.Barrier(3)

    def work(k, stopped):
        together.wait(60)
        if k in failing:
            raise ValueError(f"number {k}")
        assert stopped.wait(60)
        ended.append(k)

    with pytest.raises(ValueError, match=f"number {min(failing)}"):
        at_once(work, 3)
    assert sorted(ended) == sorted({0, 1, 2} - failing)


def test_one_alone_raises_too():
    def work(k, stopped):
        raise KeyError(k)

    with pytest.raises(KeyError):
        at_once(work, 1)


def test_an_interrupt_of_the_caller_stops_all(monkeypatch):
    ended = []

    def work(k, stopped):
        assert stopped.wait(60)
        ended.append(k)

    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("striptools.threads.wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        at_once(work, 3)
    assert sorted(ended) == [0, 1, 2]
