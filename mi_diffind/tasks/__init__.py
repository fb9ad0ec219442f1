"""Tasks, one a folder: truth, arrays, training and table file of each; found, never listed."""
