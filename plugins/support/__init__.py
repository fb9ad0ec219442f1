"""What several plugins need, and no plugin itself."""
