"""Task 3: images and materials as one primary and one cascaded array."""
