"""Verbs of ``mi-diffind``, one a module.

Each module has two functions: ``add(commands)`` defines its options; ``run(arguments)`` does the work and returns what
``--json`` writes. The keys ``interrupted`` and ``failed`` of the result decide the exit code.

``run`` imports scenes, plots and measurements itself, so that ``--help`` and a typing error are answered at once.
"""
