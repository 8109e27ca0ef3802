"""Read the elements of a PLY file by its header, within the size of the file.

http://paulbourke.net/dataformats/ply/. A property is one value, or a list with its own length in each row. Rows are
read at once if all lists of a property are equally long, which is common, otherwise row by row.
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
    """A property of an element: its name, the type of its values, and for a list the type of its lengths."""

    name: str
    value_type: str
    length_type: str | None = None


@dataclass(frozen=True)
class Element:
    """An element of a header: its name, the number of rows that the header claims, and its properties in order."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True, eq=False)
class ListColumn:
    """Values of a list property: (S,) all values in order, and (R,) the number of values in each row."""

    values: np.ndarray
    lengths: Int64[np.ndarray, " R"]


Columns = dict[str, "np.ndarray | ListColumn"]


@dataclass(frozen=True, eq=False)
class Cells:
    """The data after a header as an array of cells: bytes of a binary file, numbers of an ASCII file.

    Attributes:
        data: (n,) uint8 or float64.
        byte_order: "<", ">", or "" for ASCII.
        lines: (L + 1,) start of each line of an ASCII file, and the end, if lines and rows agree: then a row may
            have more numbers than its properties, as VCGLIB writes them. Else None.
    """

    data: UInt8[np.ndarray, " n"] | Float64[np.ndarray, " n"]
    byte_order: str
    lines: Int64[np.ndarray, " l"] | None = None

    def rows(self, start: int, count: int) -> Int64[np.ndarray, " r"] | None:
        """Return (count + 1,) the starts of the lines of the rows from `start` on, and the end of the last."""
        if self.lines is None:
            return None
        first = int(np.searchsorted(self.lines, start))
        return self.lines[first : first + count + 1]

    def size(self, value_type: str) -> int:
        """Return the number of cells that a value takes."""
        return np.dtype(value_type).itemsize if self.byte_order else 1

    def values(self, places: Int64[np.ndarray, " n"], value_type: str, *, subject: str) -> np.ndarray:
        """Return (n,) the values that begin at these places, in native byte order.

        Raises:
            InputError: an ASCII number that the type does not hold.
        """
        if self.byte_order:
            # (n, size) bytes of each value, viewed as its type.
            rows = self.data[places[:, None] + np.arange(self.size(value_type))]
            return rows.view(self.byte_order + value_type).reshape(-1).astype(value_type)
        return _converted(self.data[places], value_type, subject)

    def strided_values(
        self, start: int, shape: tuple[int, int], width: int, value_type: str, *, subject: str
    ) -> np.ndarray:
        """Return values of this shape: rows that begin `width` cells apart, with values that follow each other.

        Raises:
            InputError: an ASCII number that the type does not hold.
        """
        stored, cell = (self.byte_order + value_type, 1) if self.byte_order else ("f8", 8)
        # Strides in bytes: between rows, and between the values of a row.
        strides = (width * cell, self.size(value_type) * cell)
        # numpy refuses an array that would extend past the buffer.
        block = np.ndarray(shape, stored, buffer=self.data.data, offset=start * cell, strides=strides)
        return block.astype(value_type) if self.byte_order else _converted(block, value_type, subject)


def _converted(numbers: np.ndarray, value_type: str, subject: str) -> np.ndarray:
    """Convert ASCII numbers to a type, refusing integers that it cannot hold."""
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
    """Return the columns of an element, and the place after it.

    Nothing larger than the file is allocated, because a count that the rest of the data cannot hold is refused first.

    Args:
        cells: all data of the file.
        start: place of the element's first row.
        element: description in the header.
        subject: name of the file in messages.

    Raises:
        InputError: data that end too early, or a list of negative length.
    """
    subject = f"{subject}: element {element.name}"
    # The shortest possible row has empty lists, so that a forged count is refused before allocation.
    least = sum(cells.size(p.length_type or p.value_type) for p in element.properties)
    if element.count * least > len(cells.data) - start:
        raise _too_short(subject, element.count, len(cells.data) - start)
    if not element.count or not element.properties:
        return {p.name: _empty(p) for p in element.properties}, start
    # Assume that all rows are as long as the first one; lines of an ASCII file may be longer.
    lengths = _first_lengths(cells, start, element.properties, subject)
    width = sum(_cells_of(cells, p, n) for p, n in zip(element.properties, lengths, strict=True))
    lines = cells.rows(start, element.count)
    even = True
    if lines is not None:
        apart = np.diff(lines)
        even = bool((apart == apart[0]).all() and apart[0] >= width)
        width = int(apart[0])
    if even and start + element.count * width <= len(cells.data):
        columns = _read_uniform(cells, start, element, lengths, width, subject=subject)
        if columns is not None:
            return columns, start + element.count * width
    # Lists of different lengths are read row by row, which is slower.
    return _read_varying(cells, start, element, lines, subject)


def _empty(p: Property) -> np.ndarray | ListColumn:
    none = np.empty(0, p.value_type)
    return ListColumn(none, np.empty(0, np.int64)) if p.length_type else none


def _cells_of(cells: Cells, p: Property, length: int) -> int:
    if p.length_type is None:
        return cells.size(p.value_type)
    return cells.size(p.length_type) + length * cells.size(p.value_type)


def _first_lengths(cells: Cells, start: int, properties: Sequence[Property], subject: str) -> list[int]:
    """Return the lengths of the lists in the first row, 0 for properties that are no lists."""
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
            f"{subject}: lengths of {p.name}", expected="from 0 to the size of the file", received=f"{length}"
        )
    return length


def _read_uniform(
    cells: Cells, start: int, element: Element, lengths: Sequence[int], width: int, *, subject: str
) -> Columns | None:
    """Read an element whose lists are all as long as those of its first row; None if they are not."""
    sizes = [_cells_of(cells, p, length) for p, length in zip(element.properties, lengths, strict=True)]
    # The place of each property in the first row.
    starts = list(accumulate(sizes[:-1], initial=start))
    # The guess holds only if every list has the length of the first row's.
    for p, length, at in zip(element.properties, lengths, starts, strict=True):
        if p.length_type is not None:
            stored = p.length_type if cells.byte_order else "f8"
            if (cells.strided_values(at, (element.count, 1), width, stored, subject=subject) != length).any():
                return None
    columns: Columns = {}
    for p, length, at in zip(element.properties, lengths, starts, strict=True):
        each = 1 if p.length_type is None else length
        at += 0 if p.length_type is None else cells.size(p.length_type)
        named = f"{subject}: property {p.name}"
        values = cells.strided_values(at, (element.count, each), width, p.value_type, subject=named).reshape(-1)
        columns[p.name] = values if p.length_type is None else ListColumn(values, np.full(element.count, length))
    return columns


def _read_varying(
    cells: Cells, start: int, element: Element, lines: Int64[np.ndarray, " r"] | None, subject: str
) -> tuple[Columns, int]:
    """Read an element whose lists differ in length: first the places of all values row by row, then the values."""
    properties, data, end = element.properties, cells.data, len(cells.data)
    places = np.empty((len(properties), element.count), np.int64)
    lengths = np.zeros((len(properties), element.count), np.int64)
    # For each property the cells of its head (value or length) and of a list's item.
    steps = [(cells.size(p.length_type or p.value_type), cells.size(p.value_type)) for p in properties]
    bytewise = [p.length_type is not None and (p.length_type == "u1" or not cells.byte_order) for p in properties]
    # Walk through the rows and note the place of every value or list.
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
    # Read each property at its places; the places of list values follow from the lists' places and lengths.
    columns: Columns = {}
    for k, p in enumerate(properties):
        if p.length_type is None:
            columns[p.name] = cells.values(places[k], p.value_type, subject=f"{subject}: property {p.name}")
            continue
        head, step = steps[k]
        # The index of each value within its list.
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
