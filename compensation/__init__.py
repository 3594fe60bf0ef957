"""Offline: marker centres, drift models, validation and the report, from recorded sessions or plain arrays.

observations = observe(session_folder)          or observations_of(centres_px, camera_degC, ...)
model = fit(observations)
evaluation = evaluate(model, observations)
report("report.html", observations, model, evaluation)
"""

from thermostand.foundation.lazy_names import make_lazy_names

__getattr__, __dir__, __all__ = make_lazy_names(__name__, __file__)
