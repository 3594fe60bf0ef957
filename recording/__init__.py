"""A night on the disk: MCAP sessions, written durably, read, repaired, exported. `Session` reads one."""

from thermostand.foundation.lazy_names import make_lazy_names

__getattr__, __dir__, __all__ = make_lazy_names(__name__, __file__)
