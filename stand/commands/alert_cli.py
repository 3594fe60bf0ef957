"""`stand alert`: whether alerts reach their receivers."""

from __future__ import annotations

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, StandError
from thermostand.foundation.output import show
from thermostand.foundation.usage import one_line
from thermostand.stand.commands.reached import ConfigOption

app = App(no_args_is_help=True)
_LIMIT_S = 20.0


@app.callback()
def alert() -> None:
    """Alerts to people elsewhere.

    Example: stand alert test --config my-stand.yaml
    """


@app.command("test")
def try_them(config: ConfigOption = "simulated") -> None:
    """Send a test message to each receiver, and give the sign of life once.

    Example: stand alert test --config my-stand.yaml
    """
    from thermostand.stand.config.alerts_section import load_secrets
    from thermostand.stand.config.stand_config import load_config, packaged
    from thermostand.stand.serving.alerts import check_alerts
    from thermostand.stand.serving.alerts_process import deliver, ping

    stand = load_config(packaged("", config))
    if stand.alerts.secrets is None:
        raise ConfigError(
            f"{config}: has no alerts.secrets; name a file with `urls:` there (docs/how-to/get-alerts.md)"
        )
    check_alerts(stand.alerts)
    found = load_secrets(stand.alerts.secrets)
    text = "This is a test: alerts of this stand arrive here."
    failures = [said for _, said in deliver(stand.alerts.secrets, f"{stand.name}: test", text, _LIMIT_S)]
    failures += [failure] if (failure := ping(stand.alerts.secrets, _LIMIT_S)) else []
    for failure in failures:
        typer.echo(one_line(failure), err=True)
    if failures:
        raise StandError(f"{len(failures)} of {len(found.urls) + bool(found.alive_url)} were not reached")
    alive = ", and the sign of life was taken" if found.alive_url else "; no alive_url is given"
    line = f"{len(found.urls)} receiver{'' if len(found.urls) == 1 else 's'} took the message{alive}"
    show({"receivers": len(found.urls), "alive": bool(found.alive_url)}, [line])
