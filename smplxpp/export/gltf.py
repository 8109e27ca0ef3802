"""A template, with its skin, expressions and motion, as a binary glTF 2.0 file."""
