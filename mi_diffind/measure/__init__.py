"""
The one frame that measures accuracy against time: a clock, a store for what is measured, reports and pictures.

A study (:class:`.study.Study`, in :mod:`mi_diffind.studies`) says what is measured; :mod:`.frame` does it,
:mod:`.store` keeps what is done, :mod:`.report` writes it; :mod:`.curves` draws errors of several kinds in equal bytes.
Nothing here knows a task.
"""
