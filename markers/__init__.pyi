from thermostand.foundation.errors import DetectionError as DetectionError
from thermostand.markers.detection import Detection as Detection
from thermostand.markers.detection import detect as detect
from thermostand.markers.edge_fit import Flag as Flag
from thermostand.markers.image_file import read_image as read_image
from thermostand.markers.target import Target as Target
from thermostand.markers.target import load_target as load_target
