"""Packed numbers and masks against whole numbers of Python."""

import numpy as np
import pytest

from mi_diffind.arrays.lookup import PART, as_words, mask_flags, mask_words, pack_bits, unpack_bits


@pytest.mark.parametrize("bits", range(1, 9))
@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 31, 64, 1001])
def test_bits_survive_packing(bits, count):
    """Bit ``i`` of code ``k`` is bit ``k · bits + i`` of the bytes, the lowest first."""
    codes = np.random.default_rng(count).integers(0, 2**bits, count).astype(np.uint8)
    packed = pack_bits(codes, bits)
    assert packed.dtype == np.uint8 and packed.shape == (-(-count * bits // 8),)
    number = sum(int(code) << (k * bits) for k, code in enumerate(codes))
    assert packed.tobytes() == number.to_bytes(len(packed), "little")
    unpacked = unpack_bits(packed, count, bits)
    assert unpacked.dtype == np.uint8
    np.testing.assert_array_equal(unpacked, codes)
    wider = codes | np.uint8(0xFF << bits & 0xFF)  # what lies above is left out
    np.testing.assert_array_equal(pack_bits(wider, bits), packed)


@pytest.mark.parametrize("bits", [3, 5, 8])
def test_more_numbers_than_are_packed_at_a_time(rng, bits):
    """The parts join without a gap, also where a number's bits do not fill bytes."""
    codes = rng.integers(0, 2**bits, 2 * PART + 9).astype(np.uint8)
    number = int("".join(f"{code:0{bits}b}" for code in codes[::-1]), 2)
    packed = pack_bits(codes, bits)
    assert packed.tobytes() == number.to_bytes(-(-len(codes) * bits // 8), "little")
    np.testing.assert_array_equal(unpack_bits(packed, len(codes), bits), codes)


def test_numbers_of_more_than_a_byte():
    numbers = np.array([1000, 3, 2**17 - 1, 2**20 + 5], np.uint32)
    number = sum((int(n) % 2**17) << (17 * k) for k, n in enumerate(numbers))
    assert pack_bits(numbers, 17).tobytes() == number.to_bytes(9, "little")
    assert pack_bits(numbers.astype(np.int64)[::2], 17).tobytes() == pack_bits(numbers[::2], 17).tobytes()


def test_words(rng):
    for count in (1, 4, 5):
        packed = rng.integers(0, 256, count).astype(np.uint8)
        for spare in (0, 1):
            words = as_words(packed, spare)
            assert words.dtype == np.uint32 and len(words) == -(-count // 4) + spare
            assert words.tobytes() == packed.tobytes() + bytes(4 * len(words) - count)


def test_masks(rng):
    flags = rng.integers(0, 2, (5, 64)).astype(bool)
    words = mask_words(flags)
    assert words.dtype == np.uint32 and words.shape == (5, 2)
    number = sum(int(flag) << k for k, flag in enumerate(flags[3]))
    assert int(words[3, 0]) | int(words[3, 1]) << 32 == number
    np.testing.assert_array_equal(mask_flags(words), flags)
