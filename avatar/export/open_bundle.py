"""Open a bundle from a file, or make one in memory from a trained student, which needs torch."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avatar.runtime.bundle import SUFFIX, AvatarBundle, load_bundle


def open_bundle(source: Path, *, exact: bool = False) -> AvatarBundle:
    """Read a bundle, or make one in memory from the student in a folder.

    Args:
        source: a bundle NAME.avatar, or a folder that `avatar.train` or `smplxpp train` wrote.
        exact: make it with every number in float32.

    Raises:
        InputError: neither of them.
    """
    with bundle_file(source, exact=exact) as path:
        return load_bundle(path)


@contextmanager
def bundle_file(source: Path, *, exact: bool = False) -> Iterator[Path]:
    """Yield the file of a bundle: the source itself, or a temporary one made from the student in a folder.

    Args:
        source: a bundle or a folder, as in `open_bundle`.
        exact: make it with every number in float32.
    """
    if source.suffix.lower() == SUFFIX:
        yield source
        return
    import avatar  # torch is imported here, not for the players of bundles

    # A student is exported to a temporary file and read back, so that it is checked exactly as a bundle is.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"student{SUFFIX}"
        avatar.export_student(avatar.load(source), path, exact=exact)
        yield path
