"""Tests for which a machine is too slow take turns."""

from pathlib import Path

pytest_plugins = "pytester"
CONFTEST = Path(__file__).with_name("conftest.py").read_text()


def test_each_turn_begins_at_another_fifth_of_the_tests_that_run(pytester):
    """However many tests `-m` leaves out."""
    pytester.makeconftest(CONFTEST)
    pytester.makeini("[pytest]\nmarkers = nightly")
    one = "import pytest\n@pytest.mark.nightly\ndef test_long(): pass\n"
    many = "@pytest.mark.parametrize('k', range(50))\ndef test_quick(k): pass\n"
    pytester.makepyfile(test_0=one + many, **{f"test_{k}": one for k in range(1, 5)})
    begun = []
    for turn in range(5):
        run = pytester.inline_run("--collect-only", "-m", "nightly", "--turn", turn, "-p", "no:xdist")
        items = run.getcall("pytest_collection_finish").session.items
        assert len(items) == 5
        begun.append(items[0].path.name)
    assert len({*begun}) == 5
