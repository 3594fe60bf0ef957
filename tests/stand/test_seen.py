"""What the state of a stand says while nothing is run, and what `stand status` makes of it."""

from typing import Any, cast

from tests.stand.memory_devices import MemoryStand, run_memory_stand
from thermostand.drivers.devices.relays import NoRelays
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.errors import Unreachable
from thermostand.foundation.instants import format_local
from thermostand.stand.commands.status_snapshot import list_unsafe_parts
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.serving.api_models import NotConfirmed, snapshot_state

BEGIN = f"since {format_local(0)}"


def seen(here: MemoryStand):
    return snapshot_state(load_config(find_packaged("", "simulated")), here.stand, here.hub, here.clock)


async def test_after_a_stop_while_a_wire_is_gone_what_is_not_confirmed_is_reported_until_it_is():
    async with run_memory_stand() as here:
        for part in (here.relays, here.regulator, here.flap):
            here.stand.opened(cast("Any", part))
        here.relays.failures = [Unreachable("relays", "no answer") for _ in range(4)]  # two tries of two calls
        assert seen(here).not_confirmed == ()
        here.stand.safety.demand()
        first = [NotConfirmed(name=name, since_ns=0) for name in ("relays", "regulator", "flap")]
        assert seen(here).not_confirmed == (first[0].model_copy(update={"timer_s": 15.0}), *first[1:])
        assert any(line.startswith(f"{BEGIN}: flap ") for line in list_unsafe_parts(seen(here)))
        await here.passes(2.5)
        failure = "relays did not confirm its safe state: relays: no answer"
        assert seen(here).not_confirmed == (NotConfirmed(name="relays", since_ns=0, reason=failure, timer_s=15.0),)
        first_line, timer_line = list_unsafe_parts(seen(here))
        assert first_line.startswith(f"{BEGIN}: {failure}; ")
        assert "15 s" in timer_line
        await here.passes(6.0)
        assert seen(here).not_confirmed == ()
        assert list(list_unsafe_parts(seen(here))) == []


def test_a_stand_without_a_relay_board_has_no_timer_that_ends_heat():
    here = MemoryStand()
    here.stand.chamber.permits._relays = NoRelays("relays", VirtualClock(to_ns(0)))
    assert here.stand.chamber.permits.timer_s is None
