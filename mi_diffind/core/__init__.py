"""Errors, files, arguments, progress, and uses of private interfaces of Mitsuba and Dr.Jit."""
