"""Open files within bounds on size and content, and write them atomically; one module for each format."""

from smplxpp.core.files.array_file import read_arrays, write_arrays
from smplxpp.core.files.atomic import atomic_folder, atomic_path, atomic_write_bytes, atomic_write_text
from smplxpp.core.files.json_file import (
    as_integer,
    as_list,
    as_number,
    as_numbers,
    as_object,
    as_text,
    jsonable,
    parse_json,
    read_json,
)
from smplxpp.core.files.paths import path_inside, read_bytes, read_text, regular_file

__all__ = [
    "as_integer",
    "as_list",
    "as_number",
    "as_numbers",
    "as_object",
    "as_text",
    "atomic_folder",
    "atomic_path",
    "atomic_write_bytes",
    "atomic_write_text",
    "jsonable",
    "parse_json",
    "path_inside",
    "read_arrays",
    "read_bytes",
    "read_json",
    "read_text",
    "regular_file",
    "write_arrays",
]
