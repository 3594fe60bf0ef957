from compensation import Board as Board
from compensation import Calibration as Calibration
from compensation import CameraFile as CameraFile
from compensation import DriftModel as DriftModel
from compensation import Evaluation as Evaluation
from compensation import Observations as Observations
from compensation import Outside as Outside
from compensation import Positions as Positions
from compensation import Role as Role
from compensation import States as States
from compensation import TableSigma as TableSigma
from compensation import ViewCalibration as ViewCalibration
from compensation import Views as Views
from compensation import anchored as anchored
from compensation import calibrate as calibrate
from compensation import calibrate_views as calibrate_views
from compensation import evaluate as evaluate
from compensation import finder as finder
from compensation import fit as fit
from compensation import load_camera as load_camera
from compensation import load_model as load_model
from compensation import observations_of as observations_of
from compensation import observe as observe
from compensation import observe_positions as observe_positions
from compensation import save_model as save_model
from compensation import states as states
from compensation import write_report as write_report
from foundation.errors import ConfigError as ConfigError
from foundation.errors import StandError as StandError
from foundation.progress import progress as progress
from markers import Detection as Detection
from markers import DetectionError as DetectionError
from markers import Flag as Flag
from markers import Target as Target
from markers import detect as detect
from markers import load_target as load_target
from markers import read_image as read_image
from recording import Event as Event
from recording import Frame as Frame
from recording import FramesTable as FramesTable
from recording import Session as Session
from recording import SessionError as SessionError
from recording import StepMark as StepMark
from recording import export as export
from recording import open_whole as open_whole
from recording import trim as trim
from recording import verify as verify

report = write_report
session = open_whole

__version__: str
