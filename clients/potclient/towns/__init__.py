"""Made-up towns to drive through with a LiDAR model, with the exact truth about every point: `open_town`, `Town`."""

from potclient.towns.lidar import SENSORS, Lidar
from potclient.towns.recording import PERIOD_S, TownName, TownRecording, open_town
from potclient.towns.styles import STYLES, Style
from potclient.towns.town import Town

__all__ = [
    "PERIOD_S",
    "SENSORS",
    "STYLES",
    "Lidar",
    "Style",
    "Town",
    "TownName",
    "TownRecording",
    "open_town",
]
