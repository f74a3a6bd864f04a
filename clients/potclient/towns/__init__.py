"""Made-up towns to drive through with a LiDAR model, with the exact truth about every point: `open_town`, `Town`."""

from potclient.towns.gauntlet import GauntletRecording, open_gauntlet
from potclient.towns.lidar import SENSORS, Lidar
from potclient.towns.recording import TownName, TownRecording, open_town
from potclient.towns.styles import STYLES, Style
from potclient.towns.surveyed import PERIOD_S, Surfaces, SurveyedRecording
from potclient.towns.town import Town

__all__ = [
    "PERIOD_S",
    "SENSORS",
    "STYLES",
    "GauntletRecording",
    "Lidar",
    "Style",
    "Surfaces",
    "SurveyedRecording",
    "Town",
    "TownName",
    "TownRecording",
    "open_gauntlet",
    "open_town",
]
