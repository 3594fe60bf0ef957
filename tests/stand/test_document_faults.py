"""What a user reads about a file that cannot be used: the file, the line, the key, the value, and what to type."""

from pathlib import Path
from time import process_time

import pytest

from thermostand.foundation.document_faults import format_path
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.order import load_order, parse_order

STAND = find_packaged("", "laboratory").read_text(encoding="utf-8")


def refusal(old: str, new: str) -> str:
    assert STAND.count(old) == 1, old
    with pytest.raises(ConfigError) as refused:
        parse_document(STAND.replace(old, new), StandConfig, "mine.yaml")
    return str(refused.value)


def line_of(text: str) -> int:
    return STAND[: STAND.index(text)].count("\n") + 1


EXPOSURE = next(line for line in STAND.splitlines() if line.strip().startswith("exposure_s:"))


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("100 ms", "give a number in s, without the unit: 0.1 (got '100 ms', line {})"),
        ("0,1", "give a number in s, without the unit: 0.1 (got '0,1', line {})"),
        ("fast", "give a number in s, without the unit (got 'fast', line {})"),
        ("", "give a number in s, without the unit (nothing stands behind the key, line {})"),
        ("[1]", "give a number in s, without the unit (line {})"),
        ("-1", "must be greater than 0 (got -1, line {})"),
    ],
)
def test_a_wrong_number_is_reported_with_its_line_and_what_to_type(value: str, sentence: str):
    reported = refusal(EXPOSURE, f"{EXPOSURE.partition(':')[0]}: {value}")
    assert reported == f"mine.yaml: cameras.camera.exposure_s: {sentence.format(line_of(EXPOSURE))}"


@pytest.mark.parametrize(
    ("key", "sentence"),
    [
        ("exposre_s", "exposre_s: unknown key; correct its name, or take it out; did you mean exposure_s?"),
        ("colour", "colour: unknown key; correct its name, or take it out; known here: address,"),
    ],
)
def test_an_unknown_key_is_reported_with_the_one_that_may_be_meant_or_all_known_ones(key: str, sentence: str):
    indent = EXPOSURE[: len(EXPOSURE) - len(EXPOSURE.lstrip())]
    reported = refusal(EXPOSURE, f"{EXPOSURE}\n{indent}{key}: 1")
    assert reported.startswith(f"mine.yaml: cameras.camera.{sentence}")
    assert reported.endswith(f"(line {line_of(EXPOSURE) + 1})")


def test_keys_of_a_list_s_entries_are_known_too():
    with pytest.raises(
        ConfigError, match=r"r\.yaml: experiments\.1\.thermal_cycle\.soa_s: unknown.*did you mean soak_s\?"
    ):
        parse_document("name: r\nexperiments:\n  - thermal_cycle: {soa_s: 3}\n", Recipe, "r.yaml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "name: 00351210",
            "00351210 is 119432 in YAML, a number to base 8; put it in quotes, '00351210', or write 351210",
        ),
        ("name: 1:30", "1:30 is 90 in YAML, a number to base 60; put it in quotes, '1:30'"),
        (
            "name: 2026-01-01",
            "r.yaml: name: give text, in quotes: '2026-01-01' (got datetime.date(2026, 1, 1), line 1)",
        ),
        (
            "name: cycle\nexperiments: 5",
            "experiments: give a list: each entry behind a dash, or all in [ ] (got 5, line 2)",
        ),
        ("name: cycle\nexperiments:\n\t- warm_up: {}", "(line 3, column 1); indent with spaces, not with tabs"),
        ("name: cycle: 2", "mapping values are not allowed here (line 1, column 12); text with a colon"),
        ("name: [a", "(line 1, column 9); a bracket is not closed"),
        ("name: 'a", "(line 1, column 9); a quotation mark is not closed"),
        ("name: a\x07", "the character number 8 must not be in a text"),
    ],
)
def test_what_yaml_reads_otherwise_than_it_was_meant_is_reported(text: str, sentence: str):
    with pytest.raises(ConfigError) as refused:
        parse_document(text, Recipe, "r.yaml")
    assert str(refused.value).startswith("r.yaml: ")
    assert sentence in str(refused.value)
    assert "unicode string" not in str(refused.value)


@pytest.mark.parametrize(
    "path", sorted(Path(find_packaged("", "simulated")).parent.rglob("*.yaml")), ids=lambda path: path.stem
)
def test_no_installed_file_has_a_number_to_another_base(path: Path):
    parse_any(path.read_text(encoding="utf-8"))


def parse_any(text: str) -> None:
    from thermostand.foundation.documents import parse_yaml

    parse_yaml(text, "installed.yaml")


@pytest.mark.parametrize(
    ("key", "old", "sentence"),
    [
        (
            "target: paper9x6",
            "target: paper-9x6",
            "{}: target: paper9x6: no such file, and not one of those installed; did you",
        ),
        (
            "registers: e5cc,",
            "registers: omron-e5cc,",
            "{}: regulator.registers: e5cc: no such file, and not one of those",
        ),
        (
            "registers: icpdas-m7015,",
            "registers: omron-e5cc,",
            "{}: regulator: register map M-7015 lacks pv, sp, run",
        ),
    ],
)
def test_a_file_that_is_named_wrongly_is_reported_with_the_file_and_key_that_name_it(
    tmp_path: Path, key: str, old: str, sentence: str
):
    """When a session is planned, not when it is run."""
    file = tmp_path / "mine.yaml"
    text = find_packaged("", "simulated").read_text(encoding="utf-8")
    assert text.count(old) == 1, old
    file.write_text(text.replace(old, key))
    with pytest.raises(ConfigError) as refused:
        load_order("demo", str(file))
    assert str(refused.value).startswith(sentence.format(file))


def test_files_named_relative_to_a_file_are_found_from_anywhere(tmp_path: Path):
    text = find_packaged("", "simulated").read_text(encoding="utf-8")
    (tmp_path / "maps").mkdir()
    registers = find_packaged("registers", "omron-e5cc").read_text(encoding="utf-8")
    (tmp_path / "maps" / "ours.yaml").write_text(registers.replace("E5CC", "OURS"))
    (tmp_path / "board.yaml").write_text(find_packaged("targets", "paper-9x6").read_text(encoding="utf-8") + "# ours\n")
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace("omron-e5cc", "maps/ours.yaml").replace("target: paper-9x6", "target: board.yaml"))
    order = load_order("demo", str(file))
    assert order.target_text.endswith("# ours\n")
    assert order.config.regulator.registers == str(tmp_path / "maps" / "ours.yaml")
    assert "OURS" in order.register_texts["registers-regulator.yaml"]
    assert "maps/ours.yaml" in order.config_text


def test_a_session_keeps_the_optics_of_its_simulated_cameras(tmp_path: Path):
    """Those of a file, as it is when the run begins."""
    optics = find_packaged("optics", "nac").read_text(encoding="utf-8") + "# ours\n"
    (tmp_path / "ours.yaml").write_text(optics)
    text = find_packaged("", "simulated").read_text(encoding="utf-8")
    file = tmp_path / "mine.yaml"
    cameras = "simulation:\n  cameras: {camera: {optics: ours.yaml, drawn: 7}}\n"
    file.write_text(text.replace("simulation:\n", cameras))
    texts = load_order("demo", str(file)).attachments()
    assert texts["optics-camera.yaml"] == optics
    assert parse_order(texts, dict.fromkeys(texts, "attached")).attachments() == texts
    assert not load_order("demo", "simulated").optics_texts


@pytest.mark.parametrize("above", ["", "guard:\n", "cameras:\n camera:\n"])
def test_twenty_thousand_unknown_keys_are_refused_in_the_time_it_takes_to_read_them(above: str):
    indent = " " * above.count("\n")
    keys = "".join(f"{indent}k{number}: \n" for number in range(20_000))
    begun_s = process_time()
    with pytest.raises(ConfigError, match=r"and \d{5} more"):
        parse_document(above + keys, StandConfig, "mine.yaml")
    assert process_time() - begun_s < 10.0  # 0.4 s, and 30 s when each key was looked for among all others


def test_entries_are_counted_from_1_and_a_place_may_be_the_whole():
    assert format_path(("steps", 0, "repeat", "steps", 3)) == "steps.1.repeat.steps.4"
    assert (format_path(("thermometers", 5, "[key]")), format_path(())) == ("thermometers.5", "")
