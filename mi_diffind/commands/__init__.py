"""
The verbs of ``mi-diffind``, one a module, each with two functions: ``add(commands)`` defines its options, and
``run(arguments)`` does the work and returns what ``--json`` is to write. Of the keys of that, ``interrupted`` and
``failed`` make the exit code.

What imports Mitsuba's scenes, plots or measures is imported by ``run``, so that ``--help`` and a typing error are
answered at once.
"""
