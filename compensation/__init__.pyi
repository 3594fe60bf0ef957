from compensation.arrays import observations_of as observations_of
from compensation.calibration.board import Board as Board
from compensation.calibration.calibrate import Calibration as Calibration
from compensation.calibration.calibrate import calibrate as calibrate
from compensation.calibration.session_centres import Positions as Positions
from compensation.calibration.session_centres import observe_positions as observe_positions
from compensation.calibration.stage_geometry import TableSigma as TableSigma
from compensation.calibration.views import ViewCalibration as ViewCalibration
from compensation.calibration.views import Views as Views
from compensation.calibration.views import calibrate_views as calibrate_views
from compensation.drift.anchoring import anchored as anchored
from compensation.drift.choosing import fit as fit
from compensation.drift.drift_model import DriftModel as DriftModel
from compensation.drift.drift_model import Outside as Outside
from compensation.drift.evaluation import Evaluation as Evaluation
from compensation.drift.evaluation import evaluate as evaluate
from compensation.drift.model_file import load_model as load_model
from compensation.drift.model_file import save_model as save_model
from compensation.drift.type_prior import fit_like as fit_like
from compensation.finding.finder import finder as finder
from compensation.history.known_states import states as states
from compensation.history.states import States as States
from compensation.observations import Observations as Observations
from compensation.observations import observe as observe
from compensation.reporting.report import write_report as write_report
from experiments.steps import Role as Role

report = write_report
