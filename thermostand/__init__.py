"""The public names of thermostand, each imported when it is first used: `import thermostand` is all a notebook needs.

    session = thermostand.session("sessions/20260101T180000Z-thermal-cycle")
    session.frames_table().columns()
    observations = thermostand.observe(session.path)
    model = thermostand.fit(observations)

`thermostand.__version__` is the installed version, which pyproject.toml states.
"""

from thermostand.foundation.lazy_names import make_lazy_names

_public, __dir__, __all__ = make_lazy_names(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        import importlib.metadata

        return importlib.metadata.version("thermostand")
    return _public(name)
