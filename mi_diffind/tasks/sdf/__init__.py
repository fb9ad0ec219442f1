"""Task 6: signed distance fields."""
