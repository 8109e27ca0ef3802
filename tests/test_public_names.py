from __future__ import annotations

import smplxpp


def test_functions_stay_functions_after_their_packages_are_loaded():
    """A subpackage of the same name would take the function's place on first use."""
    for name in smplxpp.__all__:
        first = getattr(smplxpp, name)
        assert getattr(smplxpp, name) is first
    assert callable(smplxpp.pose)
    assert callable(smplxpp.unpose)
    assert "transfer_weights" in dir(smplxpp)
