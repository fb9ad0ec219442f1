"""Measurement of accuracy against time: clock, benchmark, training of contenders, reports and pictures.

A study (:class:`.study.Study`, in :mod:`mi_diffind.studies`) declares its candidates and cases; :mod:`.benchmark`
measures them, :mod:`.training` keeps trained models, :mod:`.report` writes the result. No module here knows a task.
"""
