"""The trainer of the compact avatar; nothing is built here yet."""
