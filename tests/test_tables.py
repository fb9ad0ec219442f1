"""Table files: exact round trips, nothing half-written, and one sentence for every way a file can be wrong."""

import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_diffind import StoredArray, TableError, load_table, save_table
from mi_diffind.arrays import lookup, tables
from mi_diffind.arrays.tables import Table
from mi_diffind.core.files import OutputError
from mi_diffind.core.runtime import array_module

SHAPES = {"primary.0.data": (4, 5, 2), "cascaded": (3, 3, 7)}


def example(storage="float32", seed=0) -> Table:
    rng = np.random.default_rng(seed)
    arrays = {name: rng.normal(0, 1, shape).astype(np.float32) for name, shape in SHAPES.items()}
    arrays["cascaded"][0, 0, :4] = [0.0, -0.0, 1e-45, -3e38] if storage == "float32" else [0.0, -0.0, 6e-8, -6e4]
    stored = {
        "primary.0.data": StoredArray(arrays["primary.0.data"]),
        "cascaded": StoredArray(arrays["cascaded"], ("clamp", "repeat")),
    }
    table = Table("a task", stored, "a preset", {"lr": 1e-3, "name": "α β"}, 7, {"psnr_db": 33.25})
    return table.to(storage)


def same(a: StoredArray, b: StoredArray) -> bool:
    """Are two arrays equal, bit by bit, with all that is said about them?"""
    about = [(x.entries.dtype, x.shape, x.border, x.scale, x.offset, x.bits) for x in (a, b)]
    return about[0] == about[1] and a.entries.tobytes() == b.entries.tobytes()


def changed(table: Table, name: str, **changes) -> Table:
    """A copy of ``table`` one of whose arrays is another."""
    return replace(table, arrays={**table.arrays, name: replace(table.arrays[name], **changes)})


def parts(path):
    """The members of an archive: name → bytes."""
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def rebuild(path, members, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items() if isinstance(members, dict) else members:
            archive.writestr(name, content)


def npy(array, **kwargs):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), **kwargs)
    return buffer.getvalue()


def change_meta(path, change):
    """Rewrite the file with another description: ``change`` edits it in place, or returns the text to store."""
    members = parts(path)
    meta = json.loads(np.load(io.BytesIO(members["meta.npy"])).tobytes())
    text = change(meta)
    text = text if isinstance(text, bytes) else json.dumps(meta).encode()
    members["meta.npy"] = npy(np.frombuffer(text, np.uint8))
    rebuild(path, members)


def refused(path, match=None, **kwargs):
    """The file is refused with one sentence that starts with its name."""
    with pytest.raises(TableError, match=match) as caught:
        load_table(path, **kwargs)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    assert len(message) < len(str(path)) + 250
    return message


@pytest.fixture(params=lookup.STORAGES)
def saved(request, tmp_path):
    path = tmp_path / "tables.npz"
    save_table(path, example(request.param))
    return path


@pytest.fixture
def plain(tmp_path):
    path = tmp_path / "tables.npz"
    save_table(path, example())
    return path


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_round_trip_is_exact(tmp_path, storage):
    table, path = example(storage), tmp_path / "tables.npz"
    save_table(path, table)
    loaded = load_table(path, task="a task", shapes=SHAPES)
    assert (loaded.task, loaded.preset, loaded.storage, loaded.settings, loaded.seed, loaded.measured) == (
        "a task", "a preset", storage, {"lr": 1e-3, "name": "α β"}, 7, {"psnr_db": 33.25},
    )  # fmt: skip
    assert loaded.path == path and table.path is None
    assert list(loaded.arrays) == list(table.arrays)
    for name, array in table.arrays.items():
        assert same(loaded.arrays[name], array)
        np.testing.assert_array_equal(loaded.arrays[name].values, array.values)
        assert bool(array.scale) == bool(array.offset) == (storage == "uint8") and array.bits == 8
    assert {name: array.border for name, array in loaded.arrays.items()} == {
        "primary.0.data": ("clamp", "clamp"), "cascaded": ("clamp", "repeat"),
    }  # fmt: skip
    assert loaded.nbytes == sum(a.entries.nbytes for a in table.arrays.values())
    again = tmp_path / "again.npz"
    save_table(again, loaded)
    assert again.read_bytes() == path.read_bytes()
    assert {info.date_time for info in zipfile.ZipFile(path).infolist()} == {(1980, 1, 1, 0, 0, 0)}  # no clock


@pytest.mark.parametrize(("storage", "bits"), [("float32", 8), ("float16", 8), ("uint8", 8), ("uint8", 6)])
def test_arrays_are_allocated_as_they_are(rng, storage, bits):
    """Stored, allocated and stored again is the same."""
    stored = StoredArray(rng.normal(0, 100, (4, 5, 2)).astype(np.float32), ("repeat", "clamp")).to(storage)
    if bits < 8:
        stored = replace(stored, entries=stored.entries >> (8 - bits), bits=bits)
    array = stored.allocate(array_module("llvm").TensorXf)
    assert same(StoredArray.of(array), stored)
    assert (array.storage, array.nbytes) == (storage, stored.nbytes)
    np.testing.assert_array_equal(array.numpy(), stored.values)


def test_pointers():
    """Only what stays in [0, 1] whatever byte is stored may be read without a look at the range."""
    codes = np.zeros((2, 2), np.uint8)
    for bits, scale, offset, expected in (
        (8, 1 / 255, 0.0, True), (6, 1 / 63, 0.0, True), (6, 1 / 255, 0.5, True), (8, 1 / 63, 0.0, False),
        (8, 1 / 255, 0.1, False), (8, 1 / 255, -0.1, False), (8, -1 / 255, 1.0, False),
    ):  # fmt: skip
        affine = ((1 / 255, scale), (0.0, offset))
        assert StoredArray(codes, (), *affine, bits).is_pointer == expected, (bits, scale, offset)


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_conversion(storage):
    """Each storage form is as close as it can be, and going there twice changes nothing."""
    rng = np.random.default_rng(1)
    values = rng.uniform(-1, 2, (6, 5, 3)).astype(np.float32)
    table = Table("t", {"a": StoredArray(values)}, "p", measured={"psnr_db": 1.0}, path=Path("x.npz"))
    converted = table.to(storage)
    assert converted.storage == storage and converted.arrays["a"].to(storage) is converted.arrays["a"]
    assert (converted.measured, converted.preset, converted.path) == (table.measured, "p", table.path)
    tolerance = {"float32": 0, "float16": 2 * 2.0**-11, "uint8": 3 / 255 / 2 * 1.001}[storage]
    assert np.abs(converted.arrays["a"].values - values).max() <= tolerance
    again = converted.to("float32").to(storage)
    np.testing.assert_array_equal(again.arrays["a"].values, converted.arrays["a"].values)
    assert table.nbytes == {"float32": 1, "float16": 2, "uint8": 4}[storage] * converted.nbytes
    assert table.arrays["a"].entries is values  # a copy: the table itself stays as it is
    with pytest.raises(ValueError, match="int4"):
        table.to("int4")


def narrow(bits=5, shape=(5, 3, 2)) -> Table:
    """A table whose first array has ``bits`` bits an entry, the second one 8."""
    rng = np.random.default_rng(bits)
    few = rng.integers(0, 2**bits, shape).astype(np.uint8)
    whole = rng.integers(0, 256, (4, 3), dtype=np.uint8)
    affine = {n: ((0.5,) * n, (-1.0,) * n) for n in (2, 3)}
    return Table("t", {"few": StoredArray(few, (), *affine[2], bits), "bytes": StoredArray(whole, (), *affine[3])})


@pytest.mark.parametrize("bits", range(1, 8))
def test_few_bits_make_the_round_trip(tmp_path, bits):
    table, path, again = narrow(bits), tmp_path / "t.npz", tmp_path / "again.npz"
    save_table(path, table)
    loaded = load_table(path)
    assert {name: a.bits for name, a in loaded.arrays.items()} == {"few": bits, "bytes": 8}
    for name, array in table.arrays.items():
        assert same(loaded.arrays[name], array)
        np.testing.assert_array_equal(loaded.arrays[name].values, np.float32(0.5 * array.entries - 1.0))
    size = -(-30 * bits // 8)
    assert loaded.arrays["few"].nbytes == size and loaded.nbytes == size + 12
    assert np.load(path)["few"].shape == (size,)  # what is in the file, too
    save_table(again, loaded)
    assert again.read_bytes() == path.read_bytes()


BITS = {"1 to 8": [0, 9, -1, True, 2.0, "x", [3], 10**30], "shape": [1, 2, 3, 4, 6, 7]}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        *(({"bits": bits}, match) for match, values in BITS.items() for bits in values),
        *(({"shape": shape}, "") for shape in ([5, 3, 3], [2**40] * 3, [5, -3, 2])),
    ],
)
def test_descriptions_of_other_bits(tmp_path, change, match):
    path = tmp_path / "t.npz"
    save_table(path, narrow())
    change_meta(path, lambda meta: meta["arrays"]["few"].update(change))
    refused(path, f"few.*{match}")


def test_nothing_stays_behind_when_writing_fails(plain, monkeypatch):
    before, original = plain.read_bytes(), zipfile.ZipFile.writestr

    def failing(self, info, *args):
        if info.filename != "meta.npy":
            raise OSError(28, "No space left on device")
        original(self, info, *args)

    monkeypatch.setattr(zipfile.ZipFile, "writestr", failing)
    for file in (plain, plain.with_name("new.npz")):
        with pytest.raises(OutputError, match="No space left"):
            save_table(file, example(seed=1))
    assert os.listdir(plain.parent) == [plain.name] and plain.read_bytes() == before


def _of(**arrays) -> Table:
    return Table("a task", {name: StoredArray(entries) for name, entries in arrays.items()})


UNWRITABLE = {
    "wrong type": (lambda: _of(a=np.zeros((3, 1))), "float64"),
    "NaN": (lambda: _of(a=np.full((3, 1), np.nan, np.float32)), "NaN or infinity"),
    "infinity": (lambda: _of(a=np.full((3, 1), np.inf, np.float32)), "NaN or infinity"),
    "called meta": (lambda: _of(meta=np.zeros((3, 1), np.float32)), "meta"),
    "no channels": (lambda: _of(a=np.zeros(3, np.float32)), r"shape \(3,\)"),
    "no entries": (lambda: _of(a=np.zeros((0, 1), np.uint8)), r"shape \(0, 1\)"),
    "unknown border": (lambda: changed(example(), "cascaded", border=("clamp", "mirror")), "mirror"),
    "too few borders": (lambda: changed(example(), "cascaded", border=("clamp",)), "borders"),
    "NaN measured": (lambda: replace(example(), measured={"psnr_db": float("nan")}), "cannot be written"),
    "odd settings": (lambda: replace(example(), settings={"x": object()}), "cannot be written"),
    **{
        f"{bits!r} bits": (lambda bits=bits: changed(narrow(), "few", bits=bits), "bits an entry, allowed are 1 to 8")
        for bits in BITS["1 to 8"]
    },
    "bits of floats": (lambda: changed(example(), "cascaded", bits=5), "only bytes have bits and a scale"),
    "a scale of floats": (lambda: changed(example(), "cascaded", scale=(1.0,) * 7), "only bytes have bits"),
    "no affine map": (lambda: changed(example("uint8"), "cascaded", scale=(), offset=()), "scale and offset"),
    "short affine map": (
        lambda: changed(example("uint8"), "cascaded", scale=(1.0,), offset=(0.0,)),
        "scale and offset",
    ),
    "infinite affine map": (lambda: changed(example("uint8"), "cascaded", scale=(np.inf,) * 7), "scale and offset"),
}


@pytest.mark.parametrize("fault", UNWRITABLE)
def test_unwritable_tables_are_refused(tmp_path, fault):
    """A table that could not be loaded again is not written."""
    make, match = UNWRITABLE[fault]
    with pytest.raises(TableError, match=match) as caught:
        save_table(tmp_path / "t.npz", make())
    assert "t.npz" in str(caught.value) and "\n" not in str(caught.value)
    assert not os.listdir(tmp_path)


def test_places_that_hold_no_file(tmp_path):
    (tmp_path / "file").write_text("")
    refused(tmp_path / "none.npz", "no such file")
    refused(tmp_path, "is a folder")
    refused(tmp_path / "file" / "t.npz", "cannot be read")


@pytest.mark.parametrize("content", [b"", b"hello", b"PK", b"PK\x03\x04" + bytes(100), npy(np.zeros(3)), bytes(70000)])
def test_not_an_archive(tmp_path, content):
    path = tmp_path / "t.npz"
    path.write_bytes(content)
    refused(path, "not a table file")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_methods_of_compression_are_refused(plain, method):
    """They grow faster than deflate, and no writer of table files uses them."""
    rebuild(plain, parts(plain), method)
    refused(plain, "is compressed by (bzip2|lzma), allowed are deflate and none")


def test_an_array_twice(plain):
    members = list(parts(plain).items())
    with pytest.warns(UserWarning, match="Duplicate"):
        rebuild(plain, [*members, members[-1]])
    refused(plain, "twice")


def test_an_encrypted_file(plain):
    content = bytearray(plain.read_bytes())
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        position = content.find(signature)
        while position >= 0:
            content[position + flags] |= 1
            position = content.find(signature, position + 1)
    plain.write_bytes(content)
    refused(plain, "encrypted")


def test_an_old_file(saved):
    """One sentence that says what to do. Version 1 had one storage form for all arrays, and other keys."""

    def old(meta):
        for array in meta["arrays"].values():
            storage = array.pop("storage")
        meta["quality"] = meta.pop("measured")
        meta.pop("preset")
        meta.update(format_version=1, storage=storage, task="ggx")

    change_meta(saved, old)
    message = refused(saved, "format version 1, this package reads version 2: make it again with mi-diffind fit ggx$")
    assert message.count(". ") == 0
    refused(saved, "version 1", task="ggx", shapes=SHAPES)
    change_meta(saved, lambda meta: meta.update(task=["odd"]))
    refused(saved, "make it again with mi-diffind fit TASK$")


#: Fault → change of the members of a file, and words of the refusal.
DAMAGED = {
    "no array": (lambda m: {**m, "readme.txt": b"hello"}, r"readme\.txt.*not an array"),
    "a name of two lines": (lambda m: {**m, "a\nb.npy": b"hello"}, "not an array"),
    "missing": (lambda m: {k: v for k, v in m.items() if k != "cascaded.npy"}, '"cascaded" is missing'),
    "no description": (lambda m: {k: v for k, v in m.items() if k != "meta.npy"}, '"meta"'),
    "additional": (lambda m: {**m, "more.npy": npy(np.zeros((3, 1), np.float32))}, 'unexpected array "more"'),
    "more than it holds": (
        lambda m: {**m, "cascaded.npy": m["cascaded.npy"].replace(b"(3, 3, 7)", b"(9, 9, 7)")}, "cascaded",
    ),
    "more after its end": (lambda m: {**m, "cascaded.npy": m["cascaded.npy"] + b"0"}, "holds more"),
    "fewer bytes": (lambda m: {**m, "cascaded.npy": m["cascaded.npy"][:-1]}, "holds|claims"),
    "another version of NumPy's": (
        lambda m: {**m, "cascaded.npy": m["cascaded.npy"].replace(b"NUMPY\x01", b"NUMPY\x02")}, "damaged header",
    ),
    "Fortran order": (
        lambda m: {**m, "cascaded.npy": npy(np.asfortranarray(np.zeros((3, 3, 7), np.float32)))}, "cascaded",
    ),
    **{
        str(value): (
            lambda m, value=value: {**m, "cascaded.npy": npy(np.full((3, 3, 7), value, np.float32))},
            '"cascaded" contains NaN or infinity',
        )
        for value in (np.nan, np.inf, -np.inf)
    },
    **{
        dtype: (lambda m, dtype=dtype: {**m, "cascaded.npy": npy(np.zeros((3, 3, 7), dtype))}, "type .*, expected")
        for dtype in ("<f8", ">f4", "<i4", "u1", "<f2", "S4", "<M8[s]")
    },
    **{
        f"header {bad!r}": (lambda m, bad=bad: {**m, "cascaded.npy": bad}, '"cascaded" has a damaged header')
        for bad in (b"", b"hello", b"\x93NUMPY\x09\x00", b"\x93NUMPY\x01\x00\x05\x00{'a'}")
    },
}  # fmt: skip


@pytest.mark.parametrize("fault", DAMAGED)
@pytest.mark.parametrize("shapes", [None, SHAPES])
def test_damaged_members(plain, fault, shapes):
    change, match = DAMAGED[fault]
    rebuild(plain, change(parts(plain)))
    refused(plain, match, shapes=shapes)


def test_other_arrays_than_expected(saved):
    refused(saved, 'holds tables for the task "a task", expected "another"', task="another")
    refused(saved, r'unexpected array "primary\.0\.data"', shapes={"cascaded": SHAPES["cascaded"]})
    refused(saved, '"third" is missing', shapes={**SHAPES, "third": (3, 1)})
    refused(saved, r"shape \(3, 3, 7\), expected \(3, 4, 7\)", shapes={**SHAPES, "cascaded": (3, 4, 7)})
    assert load_table(saved, shapes={**SHAPES, "cascaded": (None, None, 7)}).task == "a task"
    change_meta(saved, lambda meta: meta["arrays"]["cascaded"].update(shape=[3, 7, 3]))
    refused(saved, "cascaded")  # what is described is not what is stored


def test_pickled_objects(plain, tmp_path):
    """An object array would run code when unpickled; it is refused by its type alone."""

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "pwned"),)

    members = parts(plain)
    for name in ("cascaded.npy", "meta.npy"):
        evil = npy(np.full((3, 3, 7), Evil(), object), allow_pickle=True)
        rebuild(plain, {**members, name: evil})
        refused(plain, "has the type object")
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"1", b"{}", b"\xff\xfe\xfd", b"null", b"[" * 100_000, b"1" * 5000])
def test_damaged_description(plain, text):
    change_meta(plain, lambda meta: text)
    refused(plain)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": None}, {"shape": "abc"}, {"shape": [float("inf"), 3, 7]}, {"shape": [float("nan"), 3, 7]},
        {"shape": [21]}, {"shape": []}, {"shape": [3, 3]}, {"border": None}, {"border": ["clamp"]},
        {"border": ["clamp", "mirror"]}, {"border": "clamp"}, {"border": [[], {}]}, {"storage": "float64"},
        {"storage": None}, {"storage": []}, {"storage": {}}, {"storage": "uint8"}, {"storage": "float16"},
    ],
)  # fmt: skip
def test_damaged_array_description(plain, change):
    change_meta(plain, lambda meta: meta["arrays"]["cascaded"].update(change))
    refused(plain, "cascaded")


def test_ranges(tmp_path):
    """Entries outside of what a task allows are named with the range, up to what rounding to bytes does."""
    for low in (0.0, -0.02):
        table = Table("t", {"a": StoredArray(np.float32([[low], [0.5], [1.0005]]))}, path=tmp_path / "t.npz")
        if low == 0:
            tables.check_ranges(table, {"a": (0.0, 1.0)})
    with pytest.raises(TableError, match=r't\.npz: entries of "a" lie in \[-0\.02, .*allowed is \[0, 1\]'):
        tables.check_ranges(table, {"a": (0.0, 1.0)})
