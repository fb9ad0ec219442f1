"""Write a picture with titles above its columns of equal width.

Example: ``python scenes/labelled.py solids.png mesh field -o solids.jpg``.
"""

import argparse
from collections.abc import Sequence

from PIL import Image, ImageDraw, ImageFont

#: Height of the titles over the width of the picture, and of their letters over the height of the titles.
HEIGHT, LETTERS = 1 / 34, 0.62


def labelled(picture: Image.Image, titles: Sequence[str]) -> Image.Image:
    """Return a picture with titles on white above it, each in the middle of its column."""
    height = round(HEIGHT * picture.width)
    sheet = Image.new("RGB", (picture.width, height + picture.height), "white")
    sheet.paste(picture, (0, height))
    font = ImageFont.load_default(size=LETTERS * height)
    for i, title in enumerate(titles):
        place = (i + 0.5) * picture.width / len(titles), height / 2
        ImageDraw.Draw(sheet).text(place, title, "black", font, anchor="mm")
    return sheet


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", metavar="PICTURE", help="picture to read")
    parser.add_argument("titles", nargs="+", metavar="TITLE", help="titles, from left to right")
    parser.add_argument("-o", required=True, metavar="OUT.jpg", help="picture to write")
    arguments = parser.parse_args()
    labelled(Image.open(arguments.picture), arguments.titles).save(arguments.o, quality=90, optimize=True)


if __name__ == "__main__":
    main()
