"""A goniometric profile as a 1D indirection: an example of a package that adds a task to ``mi_diffind``."""
