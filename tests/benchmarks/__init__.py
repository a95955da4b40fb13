"""Speed and memory against the plain ways of doing the same: `make bench`.

suite.py     what is compared with what
subjects/    what is timed; each runs in a process of its own, pinned to one or two cores
plain.py     the plain ways: unfold, index_add, a sum over transforms
"""
