"""Load, render, compare, convert, check and inspect scenes."""
