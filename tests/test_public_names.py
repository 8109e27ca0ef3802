from __future__ import annotations

import pytest

import avatar
import smplxpp


@pytest.mark.parametrize("package", [smplxpp, avatar])
def test_functions_stay_functions_after_their_packages_are_loaded(package):
    """A subpackage of the same name would take the function's place on first use."""
    for name in package.__all__:
        first = getattr(package, name)
        assert getattr(package, name) is first
        assert name in dir(package)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = package.nonsense
    assert callable(smplxpp.pose)
    assert callable(smplxpp.unpose)


def test_every_package_has_the_version_of_the_distribution():
    import pipelines

    assert smplxpp.__version__ and avatar.__version__ == pipelines.__version__ == smplxpp.__version__
