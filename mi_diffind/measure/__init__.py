"""
The one frame that measures accuracy against time: a clock, a store for what is measured, reports and pictures.

A study (:class:`.study.Study`, in :mod:`mi_diffind.studies`) says what is measured; :mod:`.frame` does it,
:mod:`.store` keeps what is done, :mod:`.report` writes it. Those of several kinds in equal bytes share :mod:`.kinds`
and :mod:`.curves`. Nothing here knows a task.
"""
