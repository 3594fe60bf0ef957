from copy import deepcopy
from pathlib import Path

import pytest
import yaml

from tests.nightly import mark_nightly
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import load_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.safe_ranges import compute_largest_correction_K
from thermostand.stand.config.stand_config import find_packaged, load_config

CONFIGS = Path(__file__).parents[2] / "configs"
LABORATORY = yaml.safe_load((CONFIGS / "laboratory.yaml").read_text())
QUICK_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def changed(tmp_path: Path, path: str, value: object, overrides: list[str] | None = None) -> Path:
    data = deepcopy(LABORATORY)
    data["guard"]["overrides"] = overrides or []
    section = data
    *parents, last = path.split(".")
    for parent in parents:
        section = section.setdefault(parent, {})
    section[last] = value
    file = tmp_path / "changed.yaml"
    file.write_text(yaml.dump(data, Dumper=QUICK_DUMPER))
    return file


@pytest.mark.parametrize("name", ["simulated", "laboratory"])
def test_installed_configurations_are_valid(name: str):
    assert load_config(find_packaged("", name)).name.startswith(name)


@pytest.mark.parametrize("path", sorted((CONFIGS / "recipes").glob("*.yaml")), ids=lambda path: path.stem)
def test_installed_recipes_are_valid_and_named_as_their_file(path: Path):
    recipe = load_document(path, Recipe)
    assert recipe.name == path.stem
    assert list(recipe.plan())


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("cameras.camera.pixle_format", "Mono8", "cameras.camera.pixle_format: unknown key"),
        ("cameras.camera.address", "camera.local", "cameras.camera.address: expected an IPv4 address"),
        ("cameras.camera.exposure_s", -1, "cameras.camera.exposure_s: must be greater than 0 (got -1, line"),
        ("cameras.camera.exposure_s", "100 ms", "cameras.camera.exposure_s: give a number in s, without the unit: 0.1"),
        ("bus.address", "/dev/ttyUSB0", "bus.address: expected serial:PATH"),
        ("bus.parity", "even", "bus.parity: must be 'N', 'E' or 'O'"),
        ("relays.unit", 1, "need different units on one bus"),
        ("relays.channels", {"compressor": 0}, "relays: channels lacks heater_enable"),
        ("relays.channels", {"heater_enable": 0, "compressor": 0}, "relays: two channels share one relay"),
        ("thermometers.air.channel", 0, "thermometers: two thermometers share one channel"),
        ("axes.linear.limits", [10, 0], "axes.linear.limits: (10.0, 0.0) is not in ascending order"),
        ("axes.vertical", {}, "axes.vertical"),
        ("limits.chamber_degC", [-10, 70], "guard.max_air_degC must be above"),
        ("guard.heater_renew_s", 10, "at most half of heater_hold_s"),
        ("guard.stale_after_s", 1, "at least twice the slowest safety poll"),
        ("limits.chamber_degC", [-10, 71], "limits.chamber_degC.2: must be less than or equal to 70"),
        ("limits.chamber_degC", [-11, 60], "limits.chamber_degC.1: must be greater than or equal to -10"),
        ("limits.chamber_degC", [60, 20], "limits.chamber_degC: (60.0, 20.0) is not in ascending order"),
        ("guard.period_s", 10.5, "guard.period_s: must be less than or equal to 10"),
        ("guard.period_s", 10, "period_s + heater_renew_s must be below heater_hold_s"),
        ("guard.stale_after_s", 121, "guard.stale_after_s: must be less than or equal to 120"),
        ("guard.max_air_degC", 81, "guard.max_air_degC: must be less than or equal to 80"),
        ("guard.max_granite_degC", 81, "guard.max_granite_degC: must be less than or equal to 80"),
        ("guard.max_camera_degC", 101, "guard.max_camera_degC: must be less than or equal to 100"),
        ("guard.max_granite_degC", 59, "guard.max_granite_degC 59.0 is below the upper limits.chamber_degC"),
        ("guard.max_camera_degC", 59, "guard.max_camera_degC 59.0 is below the upper limits.chamber_degC"),
        ("guard.max_air_degC", float("nan"), "guard.max_air_degC: must be a finite number"),
        ("guard.period_s", -1, "guard.period_s: must be greater than 0"),
        ("guard.heater_renew_s", 0, "guard.heater_renew_s: must be greater than 0"),
        ("guard.heater_renew_s", 16, "heater_renew_s must be at most half of heater_hold_s"),
        ("guard.heater_hold_s", 61, "guard.heater_hold_s: must be less than or equal to 60"),
        ("guard.cooling.fall_K", 0, "guard.cooling.fall_K: must be greater than 0"),
        ("flap.poll_s", 151, "guard.flap_open_s must be at least twice flap.poll_s (151.0 s)"),
        ("guard.max_camera_degC", float("inf"), "guard.max_camera_degC: must be a finite number"),
        ("guard.heater_off.rise_K", 0, "guard.heater_off.rise_K: must be greater than 0"),
        ("guard.sensors.warn_K", 7, "guard.sensors: warn_K 7.0 is above trip_K 6.0"),
        (
            "guard.panel_change_grace_s",
            9,
            "guard.panel_change_grace_s must be at least twice the poll of regulator and relays (5.0 s)",
        ),
        ("alerts.command", "mail", "alerts.command: give a list: each entry behind a dash"),
        ("alerts.command", ["mail", ""], "alerts.command.2: must have at least 1 character"),
        ("alerts.command_limit_s", 61, "alerts.command_limit_s: must be less than or equal to 60"),
        ("compressor.state_file", "a\nb", "compressor.state_file: expected a path of printable characters"),
        ("thermometers.air.plausible_degC", [50, -40], "air.plausible_degC: (50.0, -40.0) is not in asc"),
        ("thermometers.air.offset_K", -40, "air.offset_K: must be greater than or equal to -10"),
        ("bus.address", "tcp:localhost:70000", "bus.address: expected tcp:HOST:PORT with a port of 1..65535"),
        ("bus.address", "tcp:localhost:0", "bus.address: expected tcp:HOST:PORT with a port of 1..65535"),
        ("axes.linear.address", "tcp:localhost:65536", "axes.linear.address: expected tcp:HOST:PORT with a port"),
        ("axes.linear.address", "serial:/dev/ximc/00001006", "serial:/dev/ximc/00001006 is given twice"),
        ("axes.linear.limits", [0, 301], "beyond the travel of 300 mm"),
        ("axes.rotary.limits", [-361, 40], "beyond the travel of 360 deg"),
        ("axes.linear.serial_number", 2**32, "less than or equal to 4294967295"),
        ("flap.serial_number", "", "flap.serial_number: must match pattern"),
        ("flap.travel_s", 61, "flap.travel_s: must be less than or equal to 60"),
        ("flap.backend", "..sim", "flap.backend: must match pattern"),
        ("flap.backend_address", "tcp:localhost:65536", "flap.backend_address: expected tcp:HOST:PORT with a port"),
        (
            "cameras.camera.serial_number",
            "12345678901234567",
            "cameras.camera.serial_number: must match pattern",
        ),
        ("cameras.camera.serial_number", "Kamera-µ", "cameras.camera.serial_number: must match pattern"),
        ("cameras.camera.exposure_s", 11, "cameras.camera.exposure_s: must be less than or equal to 10"),
        ("cameras.camera.temperature.min_degC", 130, "min_degC 130.0 is not below max_degC 120.0"),
        ("name", "two\nlines", "name: must be one line of characters"),
        ("name", "", "name: must have at least 1 character"),
        ("recording.directory", "a\0b", "recording.directory: expected a path of printable characters"),
        ("operator", "\x1b[2J", "operator: must be one line of characters"),
        ("simulation", {"control": "tcp:localhost:99999"}, "simulation.control: expected tcp:HOST:PORT with a port"),
        (
            "simulation",
            {"control": "tcp:localhost:1", "start": "1999-12-31T00:00:00Z"},
            "simulation.start: expected a time of the years 2000 to 2099",
        ),
        ("flap.backend", "thermostand.drivers.sim.usb", "backend and backend_address go together"),
    ],
)
def test_a_wrong_entry_names_file_and_path(tmp_path: Path, path: str, value: object, sentence: str):
    file = changed(tmp_path, path, value)
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert sentence in str(caught.value)
    assert str(caught.value).startswith(str(file))


SAFE_EDGES = [  # path, the last safe value, one that is not, what the refusal says of both
    ("compressor.min_off_s", 180, 179, "179 s is outside the safe range (at least 180 s): a compressor started"),
    ("compressor.min_on_s", 60, 59.5, "59.5 s is outside the safe range (at least 60 s): a compressor stopped"),
    ("compressor.max_starts_per_h", 12, 13, "13 is outside the safe range (at most 12): each start heats"),
    ("guard.sensors.trip_K", 10, 10.5, "10.5 K is outside the safe range (at most 10 K): a probe that"),
    ("guard.sensors.trip_after_s", 600, 601, "601 s is outside the safe range (at most 600 s): a probe that"),
    ("guard.stale_after_s", 30, 31, "31 s is outside the safe range (at most 30 s): it would be heated"),
    (
        "guard.panel_change_grace_s",
        120,
        121,
        "121 s is outside the safe range (at most 120 s): a set-point changed by hand",
    ),
    ("guard.flap_open_s", 3600, 3601, "3601 s is outside the safe range (at most 3600 s): an open flap"),
    ("guard.flap_capture_s", 7200, 7201, "7201 s is outside the safe range (at most 7200 s): a capture that hangs"),
    ("guard.disk_low_s", 1800, 1801, "1801 s is outside the safe range (at most 1800 s): it would be heated"),
    ("recording.stop_frames_below_GB", 0.5, 0.4, "0.4 GB is outside the safe range (at least 0.5 GB): telemetry"),
    ("bus.timeout_s", 2, 2.1, "2.1 s is outside the safe range (at most 2 s): the guard could wait"),
    (
        "thermometers.air.polynomial",
        [0, 0.1],
        [0, 0.11],
        "with offset_K a correction of up to 11 K over -40 to 100 degC is outside the safe range (at most 10 K)",
    ),
]


@pytest.mark.parametrize(("path", "safe", "unsafe", "sentence"), SAFE_EDGES, ids=[edge[0] for edge in SAFE_EDGES])
def test_a_value_that_disarms_a_rule_is_refused_unless_its_path_is_accepted(
    tmp_path: Path, path: str, safe: object, unsafe: object, sentence: str
):
    assert load_config(changed(tmp_path, path, safe)).list_accepted() == {}
    file = changed(tmp_path, path, unsafe)
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert str(caught.value).startswith(f"{file}: {path}: {sentence}")
    assert str(caught.value).endswith(f" {path} in guard.overrides")
    accepted = load_config(changed(tmp_path, path, unsafe, overrides=[path])).list_accepted()
    assert accepted == {path: pytest.approx(unsafe if isinstance(unsafe, int | float) else 11.0)}


def test_every_value_outside_is_named_at_once_and_accepting_one_leaves_the_others_refused(tmp_path: Path):
    data = yaml.safe_load(changed(tmp_path, "compressor.min_off_s", 10, ["compressor.min_off_s"]).read_text())
    data["guard"].update(panel_change_grace_s=300, stale_after_s=60)
    (tmp_path / "changed.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "changed.yaml")
    assert "guard.panel_change_grace_s: 300 s is outside" in str(caught.value)
    assert "guard.stale_after_s: 60 s is outside" in str(caught.value)
    assert "min_off_s: " not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["bus.timeout_s"], "guard.overrides: bus.timeout_s is not needed: 0.3 s is within its range (at most 2 s)"),
        (
            ["guard.max_air_degC"],
            "guard.overrides: guard.max_air_degC is not a path that can be overridden; those are comp",
        ),
        (["compressor"], "guard.overrides: compressor is not a path that can be overridden"),
        (["thermometers.air.offset_K"], "air.offset_K is not a path that can be overridden"),
        ([""], "guard.overrides:  is not a path that can be overridden"),
        (["compressor.min_on_s"] * 2, "guard.overrides: compressor.min_on_s is given twice"),
    ],
)
def test_an_entry_of_overrides_that_is_not_needed_or_no_path_is_refused(
    tmp_path: Path, overrides: list[str], sentence: str
):
    value = 10 if "compressor.min_on_s" in overrides else 180
    with pytest.raises(ConfigError) as caught:
        load_config(changed(tmp_path, "compressor.min_on_s", value, overrides))
    assert sentence in str(caught.value)


@pytest.mark.parametrize(("path", "value"), [("guard.stale_after_s", 121), ("bus.timeout_s", 11)])
def test_what_no_file_may_have_cannot_be_accepted(tmp_path: Path, path: str, value: float):
    with pytest.raises(ConfigError, match=f"{path}: must be less"):
        load_config(changed(tmp_path, path, value, overrides=[path]))


@pytest.mark.parametrize(
    ("offset_K", "polynomial", "largest_K"),
    [
        (0.0, (), 0.0),
        (-9.5, (), 9.5),
        (9.0, (2.0,), 11.0),
        (0.0, (0.0, 0.01), 1.0),
        (5.0, (0.0, -0.05), 7.0),
        (0.0, (0.0, 0.6, -0.01), 40.0),  # 9 K at 30 degC, between the ends
        (0.0, (0.0, 0.0, 0.0), 0.0),
        (0.0, (9.0, 0.0, -0.02, 0.0), 191.0),
        (0.0, (0.0,) * 7 + (1e-300,), 1e-286),
        (0.0, (0.0,) * 7 + (1e308,), 1e9),
        (0.0, (1e308, 1e308, 1e308), 1e9),
    ],
)
def test_the_largest_correction_of_a_thermometer_over_its_whole_range(
    offset_K: float, polynomial: tuple[float, ...], largest_K: float
):
    assert compute_largest_correction_K(offset_K, polynomial) == pytest.approx(largest_K)


def test_a_correction_that_is_largest_between_the_ends_is_found():
    """0 at both ends, 12.25 K in the middle, which a look at the ends would miss."""
    assert compute_largest_correction_K(0.0, (10.0, 0.15, -0.0025)) == pytest.approx(12.25)


@pytest.mark.parametrize(
    ("module", "sentence"),
    [
        ("no_such_module", "no module 'no_such_module'"),
        ("json.decoder", r"'json\.decoder' has no get_backend\(address\)"),
    ],
)
def test_a_flap_backend_that_is_none_is_refused_before_anything_is_opened(tmp_path: Path, module: str, sentence: str):
    changed(tmp_path, "flap.backend_address", "tcp:localhost:1")
    data = yaml.safe_load((tmp_path / "changed.yaml").read_text())
    data["flap"]["backend"] = module
    (tmp_path / "changed.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=f"flap.backend: .*{sentence}"):
        assemble(load_config(tmp_path / "changed.yaml"), Hub(), WallClock())


def test_a_key_given_twice_is_refused(tmp_path: Path):
    file = tmp_path / "twice.yaml"
    file.write_text((CONFIGS / "laboratory.yaml").read_text() + "\nlimits: {chamber_degC: [-10, 50]}\n")
    with pytest.raises(ConfigError, match=r"twice\.yaml: .*key 'limits' is given twice.*line"):
        load_config(file)


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "name: [", "\x00"])
def test_a_file_that_is_no_configuration_is_refused_with_its_name(tmp_path: Path, text: str):
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.yaml"):
        load_config(file)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name: " + "[\n" * 5000 + "]" * 5000, "nested too deeply"),
        ("name: " + "[\n" * 120_000, "nested too deeply"),
        mark_nightly("name: " + "[" * 5000 + "]" * 5000, "nested too deeply"),  # PyYAML takes a second for one line
        mark_nightly("name: " + "[" * 120_000, "nested too deeply"),
        ("name: " + "1" * 5000, "5000 digits"),
        ("name: 0x" + "f" * 9000, "name: give text, in quotes: "),
        ("name: 2026-13-45", "month must be in 1..12"),
        ("name: !!bool x", "does not fit its tag"),
        ("name: !!int ''", "does not fit its tag"),
        ("name: !!timestamp x", "does not fit its tag"),
    ],
    ids=[
        "nested",
        "nested beyond any stack",
        "nested in a line",
        "beyond any stack in a line",
        "digits",
        "hexadecimal",
        "date",
        "bool",
        "int",
        "timestamp",
    ],
)
def test_yaml_that_python_cannot_hold_is_refused_with_a_sentence(tmp_path: Path, text: str, sentence: str):
    file = tmp_path / "hostile.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_camera_of_the_simulation_is_one_of_the_stand(tmp_path: Path):
    data = yaml.safe_load((CONFIGS / "simulated.yaml").read_text())
    file = tmp_path / "stand.yaml"
    data["simulation"]["cameras"] = {"camera": {"optics": "unmodified"}}
    file.write_text(yaml.safe_dump(data))
    simulation = load_config(file).simulation
    assert simulation is not None
    assert (simulation.camera, simulation.cameras["camera"].optics) == ("modified", "unmodified")
    data["simulation"]["cameras"] = {"side": {"genicam": "side.xml"}}
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=r"simulation.cameras has side"):
        load_config(file)


@pytest.mark.parametrize(
    ("camera", "sentence"),
    [
        ({"optics": "nacc"}, "nacc: no such file.*did you mean nac\\? there are dic, nac, navcam, phone"),
        ({"optics": "unmodified", "effects": ["creep"]}, "effects and drawn need optics of a file.*are unmodified"),
        ({"drawn": 3}, "effects and drawn need optics of a file.*are None"),
        ({"optics": "nac", "effects": ["slip"]}, "simulation.cameras.camera.effects"),
        ({"optics": "own.yaml"}, "own.yaml: scale_ppm_per_K.*the lower bound comes first"),
    ],
)
def test_optics_that_cannot_be_are_refused_with_a_sentence(tmp_path: Path, camera: dict[str, object], sentence: str):
    data = yaml.safe_load((CONFIGS / "simulated.yaml").read_text())
    own = yaml.safe_load((CONFIGS / "optics" / "nac.yaml").read_text())
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({**own, "scale_ppm_per_K": [22, 15]}))
    data["simulation"]["cameras"] = {"camera": camera}
    file = tmp_path / "stand.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=sentence):
        load_config(file)


def test_optics_in_the_folder_of_the_stands_file_come_first(tmp_path: Path):
    data = yaml.safe_load((CONFIGS / "simulated.yaml").read_text())
    data["simulation"]["cameras"] = {"camera": {"optics": "own.yaml", "effects": ["creep", "sag"], "drawn": 7}}
    (tmp_path / "own.yaml").write_text((CONFIGS / "optics" / "nac.yaml").read_text())
    file = tmp_path / "stand.yaml"
    file.write_text(yaml.safe_dump(data))
    simulation = load_config(file).simulation
    assert simulation is not None
    assert simulation.cameras["camera"].optics == str(tmp_path / "own.yaml")


def test_a_missing_file_lists_the_existing_ones():
    with pytest.raises(ConfigError, match=r"thermal_cycle: no such file.*calibration, demo, .*warm-up"):
        find_packaged("recipes", "thermal_cycle")
