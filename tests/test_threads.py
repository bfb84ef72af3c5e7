"""Work on the side: in order, done on leaving, and its exceptions raised."""

import threading
import time

import pytest

from striptools.threads import Beside


@pytest.mark.parametrize("threaded", [False, True])
def test_work_beside_is_done_in_order_and_on_leaving(threaded):
    done, mine = [], threading.get_ident()

    def piece(number):
        time.sleep(0.01 if number == 0 else 0)
        done.append((number, threading.get_ident() != mine))

    with Beside(threaded=threaded) as beside:
        for number in range(5):
            beside.do(piece, number)
    assert done == [(number, threaded) for number in range(5)]


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize("pieces", [1, 3])
def test_an_exception_of_work_beside_is_raised(threaded, pieces):
    def piece(number):
        if number == 0:
            raise ValueError("the first")

    def all_pieces():
        with Beside(threaded=threaded) as beside:
            for number in range(pieces):
                beside.do(piece, number)

    with pytest.raises(ValueError, match="the first"):
        all_pieces()


def test_an_exception_of_the_caller_is_not_hidden_by_one_beside():
    def piece():
        raise ValueError("beside")

    def both():
        with Beside(threaded=True) as beside:
            beside.do(piece)
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        both()
