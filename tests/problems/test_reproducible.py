"""Objects that can be made again, and what their classes say that they take."""

import inspect

from ocp_torch.problems import Acrobot


def test_a_class_says_what_it_takes_whether_its_init_is_its_own_or_not():
    class Heir(Acrobot):
        pass

    for cls in (Acrobot, Heir):
        names = list(inspect.signature(cls).parameters)
        assert names[0] == "masses"
        assert "discount" in names
        assert "self" not in names
