"""Task 7: radiance fields."""
