"""PLY's elements: what a header says of them, and their values, read within the file's size.

http://paulbourke.net/dataformats/ply/. A property is one value or a list with its own length in each row. Rows are
read together where all lists of a property are equally long, which is the rule; otherwise row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from smplxpp.core.errors import InputError

TYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "i8" for name in ("int64", "long")},
    **{name: "u8" for name in ("uint64", "ulong")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}


@dataclass(frozen=True)
class Property:
    """A property of an element: its name, the type of its values, and of its lengths where it is a list."""

    name: str
    value_type: str
    length_type: str | None = None


@dataclass(frozen=True)
class Element:
    """An element of a header: its name, how many rows the header claims, and its properties in their order."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True, eq=False)
class ListColumn:
    """A list property's values: (S,) all of them in order, and (R,) how many are each row's."""

    values: np.ndarray
    lengths: Int64[np.ndarray, " R"]


Columns = dict[str, "np.ndarray | ListColumn"]


@dataclass(frozen=True, eq=False)
class Cells:
    """The data after a header as equal cells: bytes of a binary file, numbers of an ASCII one.

    Attributes:
        data: (n,) uint8 or float64.
        byte_order: "<", ">", or "" for ASCII.
        lines: (L + 1,) where each line of an ASCII file begins, and the end, where lines and rows agree: a row may
            then be followed by more numbers than its properties have, as VCGLIB writes them. Else None.
    """

    data: UInt8[np.ndarray, " n"] | Float64[np.ndarray, " n"]
    byte_order: str
    lines: Int64[np.ndarray, " l"] | None = None

    def rows(self, start: int, count: int) -> Int64[np.ndarray, " r"] | None:
        """(count + 1,) where the lines of the rows from `start` on begin, and where the last ends."""
        if self.lines is None:
            return None
        first = int(np.searchsorted(self.lines, start))
        return self.lines[first : first + count + 1]

    def size(self, value_type: str) -> int:
        """The cells that a value takes."""
        return np.dtype(value_type).itemsize if self.byte_order else 1

    def values(self, places: Int64[np.ndarray, " n"], value_type: str, *, subject: str) -> np.ndarray:
        """(n,) the values that begin at these places, in native byte order.

        Raises:
            InputError: an ASCII number that the type does not hold.
        """
        if self.byte_order:
            rows = self.data[places[:, None] + np.arange(self.size(value_type))]
            return rows.view(self.byte_order + value_type).reshape(-1).astype(value_type)
        return _converted(self.data[places], value_type, subject)

    def even_values(
        self, start: int, shape: tuple[int, int], width: int, value_type: str, *, subject: str
    ) -> np.ndarray:
        """`shape` values: rows that begin `width` cells apart, of values that follow each other.

        Raises:
            InputError: an ASCII number that the type does not hold.
        """
        stored, cell = (self.byte_order + value_type, 1) if self.byte_order else ("f8", 8)
        strides = (width * cell, self.size(value_type) * cell)
        # The buffer's constructor refuses what would lie outside of it.
        block = np.ndarray(shape, stored, buffer=self.data.data, offset=start * cell, strides=strides)
        return block.astype(value_type) if self.byte_order else _converted(block, value_type, subject)


def _converted(numbers: np.ndarray, value_type: str, subject: str) -> np.ndarray:
    kind = np.dtype(value_type)
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(kind)
    limits = np.iinfo(kind)
    # float(2**64 - 1) rounds up to 2**64, which uint64 does not hold: the upper limit is exclusive.
    fits = (numbers >= limits.min) & (numbers < float(limits.max) + (kind.itemsize < 8)) & (numbers == np.rint(numbers))
    if not fits.all():
        raise InputError(subject, expected=f"{kind.name} numbers", received=f"{numbers[~fits][0]:g}")
    return numbers.astype(kind)


def read_element(cells: Cells, start: int, element: Element, *, subject: str) -> tuple[Columns, int]:
    """An element's columns, and the place after it.

    Nothing larger than the file is allocated: a count that the rest of the data cannot hold is refused first.

    Args:
        cells: all data.
        start: where the element's rows begin.
        element: from the header.
        subject: the file, for messages.

    Raises:
        InputError: data that end too early, or a list of negative length.
    """
    subject = f"{subject}: element {element.name}"
    least = sum(cells.size(p.length_type or p.value_type) for p in element.properties)
    if element.count * least > len(cells.data) - start:
        raise _too_short(subject, element.count, len(cells.data) - start)
    if not element.count or not element.properties:
        return {p.name: _empty(p) for p in element.properties}, start
    lengths = _first_lengths(cells, start, element.properties, subject)
    width = sum(_cells_of(cells, p, n) for p, n in zip(element.properties, lengths, strict=True))
    lines = cells.rows(start, element.count)
    even = True
    if lines is not None:
        apart = np.diff(lines)
        even = bool((apart == apart[0]).all() and apart[0] >= width)
        width = int(apart[0])
    if even and start + element.count * width <= len(cells.data):
        columns = _read_even(cells, start, element, lengths, width, subject=subject)
        if columns is not None:
            return columns, start + element.count * width
    return _read_uneven(cells, start, element, lines, subject)


def _empty(p: Property) -> np.ndarray | ListColumn:
    none = np.empty(0, p.value_type)
    return ListColumn(none, np.empty(0, np.int64)) if p.length_type else none


def _cells_of(cells: Cells, p: Property, length: int) -> int:
    if p.length_type is None:
        return cells.size(p.value_type)
    return cells.size(p.length_type) + length * cells.size(p.value_type)


def _first_lengths(cells: Cells, start: int, properties: Sequence[Property], subject: str) -> list[int]:
    """The lengths of the first row's lists, 0 for a property that is none."""
    lengths, place = [], start
    for p in properties:
        lengths.append(_length_at(cells, place, p, subject) if p.length_type else 0)
        place += _cells_of(cells, p, lengths[-1])
    return lengths


def _length_at(cells: Cells, place: int, p: Property, subject: str) -> int:
    assert p.length_type is not None
    if place + cells.size(p.length_type) > len(cells.data):
        raise _too_short(subject, place, len(cells.data))
    length = int(cells.values(np.array([place]), p.length_type, subject=f"{subject}: lengths of {p.name}")[0])
    if length < 0 or length > len(cells.data):
        raise InputError(
            f"{subject}: lengths of {p.name}", expected="none below 0 or beyond the file", received=f"{length}"
        )
    return length


def _read_even(
    cells: Cells, start: int, element: Element, lengths: Sequence[int], width: int, *, subject: str
) -> Columns | None:
    """An element all of whose rows are as its first one is; None where they are not."""
    sizes = [_cells_of(cells, p, length) for p, length in zip(element.properties, lengths, strict=True)]
    starts = list(accumulate(sizes[:-1], initial=start))
    for p, length, at in zip(element.properties, lengths, starts, strict=True):
        if p.length_type is not None:
            stored = p.length_type if cells.byte_order else "f8"
            if (cells.even_values(at, (element.count, 1), width, stored, subject=subject) != length).any():
                return None
    columns: Columns = {}
    for p, length, at in zip(element.properties, lengths, starts, strict=True):
        each = 1 if p.length_type is None else length
        at += 0 if p.length_type is None else cells.size(p.length_type)
        named = f"{subject}: property {p.name}"
        values = cells.even_values(at, (element.count, each), width, p.value_type, subject=named).reshape(-1)
        columns[p.name] = values if p.length_type is None else ListColumn(values, np.full(element.count, length))
    return columns


def _read_uneven(
    cells: Cells, start: int, element: Element, lines: Int64[np.ndarray, " r"] | None, subject: str
) -> tuple[Columns, int]:
    """An element whose lists differ in length: the places of all values first, row by row."""
    properties, data, end = element.properties, cells.data, len(cells.data)
    places = np.empty((len(properties), element.count), np.int64)
    lengths = np.zeros((len(properties), element.count), np.int64)
    steps = [(cells.size(p.length_type or p.value_type), cells.size(p.value_type)) for p in properties]
    bytewise = [p.length_type is not None and (p.length_type == "u1" or not cells.byte_order) for p in properties]
    place = start
    for row in range(element.count):
        if lines is not None:
            place = int(lines[row])
        for k, p in enumerate(properties):
            places[k, row] = place
            head, step = steps[k]
            if place + head > end:
                raise _too_short(subject, element.count, end - start)
            if p.length_type is None:
                place += head
                continue
            length = _length_at(cells, place, p, subject) if not bytewise[k] else _plain_length(data[place], p, subject)
            lengths[k, row] = length
            place += head + length * step
    if place > end:
        raise _too_short(subject, element.count, end - start)
    columns: Columns = {}
    for k, p in enumerate(properties):
        if p.length_type is None:
            columns[p.name] = cells.values(places[k], p.value_type, subject=f"{subject}: property {p.name}")
            continue
        head, step = steps[k]
        within = np.arange(lengths[k].sum()) - np.repeat(np.cumsum(lengths[k]) - lengths[k], lengths[k])
        inner = np.repeat(places[k] + head, lengths[k]) + step * within
        values = cells.values(inner, p.value_type, subject=f"{subject}: property {p.name}")
        columns[p.name] = ListColumn(values, lengths[k])
    return columns, place if lines is None else int(lines[-1])


def _plain_length(value: float, p: Property, subject: str) -> int:
    if not 0 <= value < 2**53 or value != int(value):
        raise InputError(
            f"{subject}: lengths of {p.name}", expected="whole numbers, none below 0", received=f"{value:g}"
        )
    return int(value)


def _too_short(subject: str, count: int, rest: int) -> InputError:
    return InputError(
        subject,
        expected=f"the {count} rows that the header announces",
        received=f"a file that ends before them, {rest} bytes or numbers from their start",
        remedy="the file is damaged or incomplete: copy or export it again",
    )
