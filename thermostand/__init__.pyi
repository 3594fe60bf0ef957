from thermostand.compensation import Board as Board
from thermostand.compensation import CameraCalibration as CameraCalibration
from thermostand.compensation import CameraFile as CameraFile
from thermostand.compensation import DriftModel as DriftModel
from thermostand.compensation import Evaluation as Evaluation
from thermostand.compensation import Observations as Observations
from thermostand.compensation import Outside as Outside
from thermostand.compensation import Positions as Positions
from thermostand.compensation import Role as Role
from thermostand.compensation import States as States
from thermostand.compensation import TableSigma as TableSigma
from thermostand.compensation import ViewCalibration as ViewCalibration
from thermostand.compensation import Views as Views
from thermostand.compensation import calibrate as calibrate
from thermostand.compensation import calibrate_views as calibrate_views
from thermostand.compensation import evaluate as evaluate
from thermostand.compensation import finder as finder
from thermostand.compensation import fit as fit
from thermostand.compensation import load_camera as load_camera
from thermostand.compensation import load_model as load_model
from thermostand.compensation import observations_of as observations_of
from thermostand.compensation import observe as observe
from thermostand.compensation import observe_positions as observe_positions
from thermostand.compensation import rereference as rereference
from thermostand.compensation import save_model as save_model
from thermostand.compensation import states as states
from thermostand.compensation import write_report as write_report
from thermostand.foundation.errors import ConfigError as ConfigError
from thermostand.foundation.errors import StandError as StandError
from thermostand.foundation.progress import progress as progress
from thermostand.markers import Detection as Detection
from thermostand.markers import DetectionError as DetectionError
from thermostand.markers import Flag as Flag
from thermostand.markers import Target as Target
from thermostand.markers import detect as detect
from thermostand.markers import load_target as load_target
from thermostand.markers import read_image as read_image
from thermostand.recording import Event as Event
from thermostand.recording import Frame as Frame
from thermostand.recording import FramesTable as FramesTable
from thermostand.recording import Session as Session
from thermostand.recording import SessionError as SessionError
from thermostand.recording import StepMark as StepMark
from thermostand.recording import export as export
from thermostand.recording import open_whole as open_whole
from thermostand.recording import trim as trim
from thermostand.recording import verify as verify

report = write_report
session = open_whole

__version__: str
