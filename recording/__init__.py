"""Sessions on the disk, in MCAP: they are written durably, read, repaired and exported here. `Session` reads one."""

from thermostand.foundation.lazy_names import make_lazy_names

__getattr__, __dir__, __all__ = make_lazy_names(__name__, __file__)
