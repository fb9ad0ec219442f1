"""Colours, errors between images, films and headers of image files."""
