"""Measurement of accuracy against time: clock, benchmark, store of partial results, reports and pictures.

A study (:class:`.study.Study`, in :mod:`mi_diffind.studies`) declares its candidates and cases; :mod:`.benchmark`
measures them, :mod:`.store` keeps partial results, :mod:`.report` writes the result. No module here knows a task.
"""
