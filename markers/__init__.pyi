from foundation.errors import DetectionError as DetectionError
from markers.detection import Detection as Detection
from markers.detection import detect as detect
from markers.edge_fit import Flag as Flag
from markers.image_file import read_image as read_image
from markers.target import Target as Target
from markers.target import load_target as load_target
