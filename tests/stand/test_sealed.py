"""Sealed files: valid JSON that is not what was written does not count."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.foundation.sealed import seal, unseal

WORDS = st.text('ab{}\n"µ', max_size=8)
CONTENTS = st.dictionaries(WORDS, st.floats(allow_nan=False) | WORDS | st.none(), min_size=1, max_size=4)


@given(CONTENTS, st.sampled_from([None, 1]))
def test_what_was_sealed_is_read_as_it_was_and_stays_json_for_all(content, indent):
    data = seal("queue", json.dumps(content, indent=indent))
    assert json.loads(unseal("queue", data)) == content
    assert json.loads(data).keys() - {"crc32"} == content.keys() - {"crc32"}


@given(CONTENTS, st.data())
def test_nothing_else_is_believed(content, data):
    whole = seal("queue", json.dumps(content))
    place = data.draw(st.integers(0, len(whole) - 1))
    spoilt = bytearray(whole)
    spoilt[place] ^= 1 << data.draw(st.integers(0, 7))
    for other in (bytes(spoilt), whole[:place], whole + b"\0", b"", json.dumps(content).encode()):
        with pytest.raises(ValueError, match="checksum"):
            unseal("queue", other)
    with pytest.raises(ValueError, match="checksum"):
        unseal("latch", whole)
