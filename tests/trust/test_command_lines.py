"""Command lines with numbers of extreme size, unknown words and control characters: each ends with an exit code, and a
refusal is one sentence. Verbs, tasks and options are those of the parsers, so that a new option is attacked, too.
"""

import argparse
import shutil

import pytest
from damage import MUTANTS, hostile
from hypothesis import given
from hypothesis import strategies as st
from limited_child import GOOD, LimitedChild
from trial_files import all_seeds

from mi_diffind.commands import cli
from mi_diffind.studies import studies

SCENE = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>
        <integer name="height" value="4"/></film><sampler type="independent"><integer name="sample_count" value="1"/>
        </sampler></sensor>
    <shape type="sphere"/>
</scene>
"""

#: Options that say how long a command works: a large number of them is a long run, not a fault.
LONG = {"steps", "seconds", "spp", "views", "test", "workers", "rounds"}

#: Options that would let the command reach beyond its folder or another machine.
LEFT_OUT = {"help", "scheduler", "version"}

INVALID = ("-1", "0", "nan", "inf", "-inf", "x", "", "1.5", "1e400", "\x1b[31m", "x" * 5000, "١٢", "0x10", " 7")
EXTREME = (*INVALID, "1e300", "1e-300", "-1e30", str(2**31 - 1), str(2**31), str(2**32), str(2**63), str(2**64),
           str(2**70), "9" * 400)  # fmt: skip

#: Verb, or verb and task → words that make it a short command.
SHORT = {
    "render": ["scene.xml", "-o", "out.png", "--spp", "1"],
    "compare": ["scene.xml", "--spp", "1"],
    "capture": ["scene.xml", "-o", "views", "--views", "2", "--test", "1", "--resolution", "4", "--spp", "1"],
    "convert": ["scene.xml", "-o", "new.xml"],
    "regress": ["scene.xml", "--spp", "1"],
    "inspect": ["image.npz"],
    "decode": ["image.npz", "-o", "out.png"],
    "examples": ["scenes"],
    "fetch": [],  # lists what there is; names would ask other machines
    "fit ggx": ["-o", "out.npz", "--steps", "1", "--batch", "64", "--primary", "4", "--cascaded", "3"],
}


def parsers():
    """The parsers of all verbs, and of their tasks and studies, by their words."""
    by_words = {}
    for verb in cli.VERBS:
        root = cli._parser([verb, *studies()])
        sub = next(a for a in root._actions if isinstance(a, argparse._SubParsersAction)).choices[verb]
        below = [a for a in sub._actions if isinstance(a, argparse._SubParsersAction)]
        by_words |= {f"{verb} {name}": p for name, p in below[0].choices.items()} if below else {verb: sub}
    return by_words


PARSERS = parsers()


def option_words(parser):
    """Options of a parser, each with an extreme value, or two of them."""
    actions = [a for a in parser._actions if a.option_strings and a.dest not in LEFT_OUT]

    @st.composite
    def words(draw):
        action = draw(st.sampled_from(actions))
        flag = action.option_strings[-1]
        if action.nargs == 0:
            return [flag]
        values = INVALID if action.dest in LONG else EXTREME
        if action.choices:
            values = (*map(str, action.choices), *INVALID)
        count = action.nargs if isinstance(action.nargs, int) else 1
        drawn = [draw(st.sampled_from(values)) for _ in range(count)]
        # A value that begins with a dash would be taken for an option
        return [f"{flag}={drawn[0]}"] if count == 1 else [flag, *drawn]

    return st.lists(words(), min_size=1, max_size=2).map(lambda lists: [word for each in lists for word in each])


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    (folder / "scene.xml").write_text(SCENE)
    shutil.copy(all_seeds()["image_indices"], folder / "image.npz")
    with LimitedChild(folder) as limited:
        yield limited


@pytest.mark.parametrize(
    "name, examples",
    [
        *((name, 4) for name in sorted(SHORT)),
        *(pytest.param(name, MUTANTS // 10, marks=pytest.mark.slow) for name in sorted(PARSERS)),
    ],
)
def test_extreme_options(child, name, examples):
    parser, short = PARSERS[name], SHORT.get(name)
    if short is None:  # its source is missing, which ends the command once the options are read
        sources = ["missing.xml" for a in parser._actions if not a.option_strings and a.nargs != "*"]
        short = [*sources, *(["-o", "out.npz"] if "output" in {a.dest for a in parser._actions} else [])]

    @hostile(examples)
    @given(words=option_words(parser))
    def each(words):
        arguments = [*name.split(), *short, *words]
        answer = child.check("command", arguments=arguments)
        assert answer["outcome"] in GOOD, (answer, arguments)

    each()
