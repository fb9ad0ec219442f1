from __future__ import annotations  # Delayed parsing of type annotations

import mitsuba as mi

from mi_diffind.tasks.task import tasks

from . import Plugin
from .support import properties, tables
from .support.solids import Placement, Solid

def open_model(props: mi.Properties):
    return tables.open_tables(props, tasks()["sdf"])


class NeuralSDF(Solid):
    def __init__(self, props: mi.Properties):
        model = open_model(props)
        smooth = properties.one_of(props, "normals", ("smooth", "analytic")) == "smooth"
        placement = Placement.of(props.get("to_world", mi.ScalarTransform4f()), model.scale, model.centre)
        self.model = model
        super().__init__(props, model.field, placement, smooth)


PLUGIN = Plugin("neural_sdf", "shape", NeuralSDF, task="sdf")
