"""A crew: results in order, all done before any is told, exceptions raised."""

import threading
import time

import pytest

from striptools.threads import Crew, in_chunks


@pytest.mark.parametrize("size", [1, 2, 5])
def test_each_thing_is_done_once_and_told_in_order(size):
    threads = set()

    def square(number):
        time.sleep(0.001 * (3 - number % 4))
        threads.add(threading.get_ident())
        return number * number

    with Crew(size) as crew:
        for count in (0, 1, 2, 20):
            assert crew.each(square, range(count)) == [number * number for number in range(count)]
        assert crew.each(square, iter([3])) == [9]
    mine = threading.get_ident()
    assert threads == {mine} if size == 1 else len(threads - {mine}) == size


@pytest.mark.parametrize("size", [1, 3])
def test_an_exception_is_raised_once_all_are_done(size):
    done = []

    def work(number):
        if number in (1, 2):
            raise ValueError(f"number {number}")
        time.sleep(0.01)
        done.append(number)

    with Crew(size) as crew:
        with pytest.raises(ValueError, match="number 1"):
            crew.each(work, [0, 1, 2, 3])
        assert sorted(done) == ([0] if size == 1 else [0, 3])
        assert crew.each(abs, [-1, -2]) == [1, 2]


@pytest.mark.parametrize("count", [0, 9, 10, 100, 101])
def test_chunks_are_the_same_by_a_crew(count):
    with Crew(3) as crew:
        assert in_chunks(list, count, crew, 5) == in_chunks(list, count, 3, 5)
