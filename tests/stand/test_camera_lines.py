"""Cameras on one line: the pause between their packets, and what the line carries."""

from dataclasses import replace

import pytest
import yaml

from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.devices.cameras.cameras_by_protocol import check_line
from thermostand.drivers.devices.cameras.shared_line import compute_line_shares
from thermostand.drivers.wires.camera_line import compute_frame_wire_s, compute_packet_delay_ns
from thermostand.experiments.steps import Capture
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.estimating.estimate import price_plan

RECIPE = """
name: captures
experiments:
  - calibration: {equilibrium_s: 60, linear_mm: [0], rotary_deg: [0], frames_per_position: 2}
"""


def of(cameras: int, **changes: object) -> StandConfig:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    own = {"boot_s": 4.0, "packet_size": 8000, **changes}
    names = ["camera", "left", "right", *(f"other{number}" for number in range(cameras))][:cameras]
    data["cameras"] = {name: {"address": f"127.0.1.{number + 1}", **own} for number, name in enumerate(names)}
    return parse_document(yaml.safe_dump(data), StandConfig, "stand")


def test_between_two_packets_of_one_camera_one_of_each_other_fits():
    on_wire_ns = 8038 * 8  # a byte takes 8 ns at 1 Gbit/s, and Ethernet adds 38 to a packet
    assert compute_packet_delay_ns(8000, 1000.0, 1) == 0
    assert compute_packet_delay_ns(8000, 1000.0, 3) == pytest.approx(2 * on_wire_ns, rel=0.11)
    assert compute_packet_delay_ns(8000, 1000.0, 3) >= 2 * on_wire_ns
    assert compute_packet_delay_ns(8000, 10_000.0, 3) == pytest.approx(
        compute_packet_delay_ns(8000, 1000.0, 3) / 10, abs=1
    )


def test_a_frame_takes_as_long_as_its_packets_and_their_pauses():
    packets = 5_013_504 // 7964 + 1 + 2  # payloads, leader and trailer
    assert compute_frame_wire_s(5_013_504, 8000, 1000.0) == pytest.approx(packets * 64.304e-6)
    assert compute_frame_wire_s(5_013_504, 8000, 1000.0, 100_000) == pytest.approx(packets * 164.304e-6)


def test_three_cameras_of_5_MP_at_2_frames_a_second_fit_on_one_line():
    lines = compute_line_shares(of(3).cameras)
    assert [line.shared_by for line in lines] == [3, 3, 3]
    assert sum(line.share for line in lines) == pytest.approx(0.244, abs=0.002)
    assert all(line.frame_s < 0.5 for line in lines)
    assert str(lines[0]).startswith("camera: 3 on a line of 1000 Mbit/s, 141.5 us between packets of 8000 bytes")


def test_what_the_line_does_not_carry_is_refused_before_the_session():
    with pytest.raises(ConfigError, match="1000 Mbit/s that 16 cameras"):
        price_plan(parse_document(RECIPE, Recipe, "recipe").plan(), of(16))
    with pytest.raises(ConfigError, match="100 Mbit/s that 3 cameras"):
        price_plan(parse_document(RECIPE, Recipe, "recipe").plan(), of(3, line_Mbps=100))
    assert price_plan(parse_document(RECIPE, Recipe, "recipe").plan(), of(3))


def test_the_check_shows_what_each_camera_needs_of_a_shared_line():
    assert list(check_line(of(1).cameras, "camera")) == []
    (fits,) = check_line(of(3).cameras, "left")
    assert (fits.device, fits.verdict, fits.advice) == ("left", "ok", "")
    assert fits.text.startswith("3 on a line of 1000 Mbit/s, 141.5 us between packets")
    (slow,) = check_line(of(2, line_Mbps=100).cameras, "left")
    assert (slow.verdict, bool(slow.advice)) == ("failed", True)


def test_each_camera_learns_how_many_share_its_line():
    cameras = assemble(of(3), Hub(), WallClock()).devices.cameras.values()
    assert [camera.settings.line_shared_by for camera in cameras if isinstance(camera, AravisCamera)] == [3, 3, 3]
    own = assemble(of(2, line_shared_by=1), Hub(), WallClock()).devices.cameras["camera"]
    assert isinstance(own, AravisCamera)
    assert own.settings.line_shared_by == 1


CAPTURE_OF = """
name: captures
experiments:
  - steps: [{{start_chamber: 24}}, {{power_camera: on}}, open_flap, {{capture: {{cameras: [{name}]}}}}, close_flap]
"""


def test_a_capture_may_name_its_cameras_which_the_stand_has_to_have():
    plan = parse_document(CAPTURE_OF.format(name="left"), Recipe, "recipe").plan()
    captures = [each.planned.step for each in price_plan(plan, of(3)) if isinstance(each.planned.step, Capture)]
    assert [capture.cameras for capture in captures] == [("left",)]
    assert captures[0].parameters["cameras"] == ("left",)
    assert "cameras" not in replace(captures[0], cameras=()).parameters
    with pytest.raises(ConfigError, match=r"no camera top; .* camera, left, right"):
        price_plan(parse_document(CAPTURE_OF.format(name="top"), Recipe, "recipe").plan(), of(3))
