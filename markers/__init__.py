"""Images -> identified marker centres. `detect(image, target)` takes arrays and gives arrays."""

from thermostand.foundation.lazy_names import make_lazy_names

__getattr__, __dir__, __all__ = make_lazy_names(__name__, __file__)
