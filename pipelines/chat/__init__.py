"""Converse with an avatar in a page: hear or read a message, get an answer, speak it and move."""
