"""`stand alert`: whether alerts reach their receivers."""

from __future__ import annotations

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, StandError
from thermostand.foundation.output import show
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.endpoint import ConfigOption

app = App(no_args_is_help=True)
_LIMIT_S = 20.0  # for an address, as in serving/alerts.py


@app.callback()
def alert() -> None:
    """Alerts to people elsewhere.

    Example: stand alert test --config my-stand.yaml
    """


@app.command("test")
def send_test_message(config: ConfigOption = "simulated") -> None:
    """Send a test message to each receiver, and give the sign of life once.

    Example: stand alert test --config my-stand.yaml
    """
    from thermostand.stand.config.alerts_section import AlertSecrets, load_secrets
    from thermostand.stand.config.stand_config import find_packaged, load_config
    from thermostand.stand.serving.alerts import check_alerts
    from thermostand.stand.serving.alerts_process import deliver, ping, run_command

    stand = load_config(find_packaged("", config))
    alerts = stand.alerts
    if alerts.secrets is None and not alerts.command:
        raise ConfigError(
            f"{config}: has neither alerts.secrets nor alerts.command; name a file with `urls:`, or a program "
            "(docs/explanation/safety.md)"
        )
    check_alerts(alerts)
    found = AlertSecrets() if alerts.secrets is None else load_secrets(alerts.secrets)
    title, text = f"{stand.name}: test", "This is a test: alerts of this stand arrive here."
    failures: list[tuple[int, str]] = []
    if alerts.secrets is not None:
        failures += deliver(alerts.secrets, _LIMIT_S, title, text) + ping(alerts.secrets, _LIMIT_S)
    if alerts.command:
        failures += run_command(alerts.command, alerts.command_limit_s, title, text)
    for _, failure in failures:
        typer.echo(escape_line(failure), err=True)
    receivers = len(found.urls) + bool(alerts.command)
    if failures:
        raise StandError(f"{len(failures)} of {receivers + bool(found.alive_url)} were not reached")
    alive = ", and the sign of life was taken" if found.alive_url else "; no alive_url is given"
    line = f"{receivers} receiver{'' if receivers == 1 else 's'} took the message{alive}"
    show({"receivers": receivers, "alive": bool(found.alive_url)}, [line])
