"""Mapweave as a library: `mapweave.read_map_file`, `mapweave.HybridMap` and what else is named here.

A name is imported when it is first used, so `import mapweave` loads no library. What is not named here may
change from one version to the next. Tests import these names from here; no module of the package does.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING

# One core a robot. The filters' matrices are small: on a busy machine, BLAS threads that wait for each other
# made an update of the localization filter forty times slower. numpy reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from mapweave.agent.drivers.robot import Robot as Robot
    from mapweave.agent.observation import Command as Command
    from mapweave.agent.observation import Observation as Observation
    from mapweave.agent.observation import Odometry as Odometry
    from mapweave.agent.observation import RobotDescription as RobotDescription
    from mapweave.agent.recordings.camera_file import read_camera as read_camera
    from mapweave.file_map import FileMap as FileMap
    from mapweave.file_map import open as open
    from mapweave.fleet import Fleet as Fleet
    from mapweave.fleet import connect as connect
    from mapweave.fleet_events import FleetEvent as FleetEvent
    from mapweave.fleet_events import MapChanged as MapChanged
    from mapweave.hybridmap.agent_status import AgentStatus as AgentStatus
    from mapweave.hybridmap.agent_status import FleetStatus as FleetStatus
    from mapweave.hybridmap.agent_status import RobotEntry as RobotEntry
    from mapweave.hybridmap.area import Area as Area
    from mapweave.hybridmap.camera import Camera as Camera
    from mapweave.hybridmap.errors import MapweaveError as MapweaveError
    from mapweave.hybridmap.errors import NotConnected as NotConnected
    from mapweave.hybridmap.errors import Refused as Refused
    from mapweave.hybridmap.explanation import MapsExplanation as MapsExplanation
    from mapweave.hybridmap.explanation import PairExplanation as PairExplanation
    from mapweave.hybridmap.explanation import RouteExplanation as RouteExplanation
    from mapweave.hybridmap.hybrid_map import HybridMap as HybridMap
    from mapweave.hybridmap.ids import MapId as MapId
    from mapweave.hybridmap.ids import NodeId as NodeId
    from mapweave.hybridmap.manual_constraint import ManualConstraint as ManualConstraint
    from mapweave.hybridmap.map_event import MapEvent as MapEvent
    from mapweave.hybridmap.map_event import MapEventKind as MapEventKind
    from mapweave.hybridmap.mission_order import MissionKind as MissionKind
    from mapweave.hybridmap.mission_order import MissionReport as MissionReport
    from mapweave.hybridmap.mission_order import MissionState as MissionState
    from mapweave.hybridmap.node import Edge as Edge
    from mapweave.hybridmap.node import EdgeKind as EdgeKind
    from mapweave.hybridmap.node import Landmarks as Landmarks
    from mapweave.hybridmap.node import Node as Node
    from mapweave.hybridmap.pose import Pose2 as Pose2
    from mapweave.hybridmap.pose import PoseGaussian as PoseGaussian
    from mapweave.hybridmap.query import Certainty as Certainty
    from mapweave.hybridmap.query import RelocalizeAnswer as RelocalizeAnswer
    from mapweave.hybridmap.query import View as View
    from mapweave.map import Map as Map
    from mapweave.mapserver.own_maps import maps_of as maps_of
    from mapweave.mapserver.relocalization.relocalizer import Relocalizer as Relocalizer
    from mapweave.node_table import NodeTable as NodeTable
    from mapweave.offline_merge import merge_map_files as merge_map_files
    from mapweave.offline_relocalization import relocalizer_of as relocalizer_of
    from mapweave.storage.image_file import read_grey as read_grey
    from mapweave.storage.map_file import MapFile as MapFile
    from mapweave.storage.map_file import read_map_file as read_map_file
    from mapweave.storage.map_file import write_map_file as write_map_file
    from mapweave.view_features import view_of as view_of

    __version__: str
else:
    _NAMES = {
        "mapweave.agent.drivers.robot": ("Robot",),
        "mapweave.agent.observation": ("Command", "Observation", "Odometry", "RobotDescription"),
        "mapweave.agent.recordings.camera_file": ("read_camera",),
        "mapweave.file_map": ("FileMap", "open"),
        "mapweave.fleet": ("Fleet", "connect"),
        "mapweave.fleet_events": ("FleetEvent", "MapChanged"),
        "mapweave.hybridmap.agent_status": ("AgentStatus", "FleetStatus", "RobotEntry"),
        "mapweave.hybridmap.area": ("Area",),
        "mapweave.hybridmap.camera": ("Camera",),
        "mapweave.hybridmap.errors": ("MapweaveError", "NotConnected", "Refused"),
        "mapweave.hybridmap.explanation": ("MapsExplanation", "PairExplanation", "RouteExplanation"),
        "mapweave.hybridmap.hybrid_map": ("HybridMap",),
        "mapweave.hybridmap.ids": ("MapId", "NodeId"),
        "mapweave.hybridmap.manual_constraint": ("ManualConstraint",),
        "mapweave.hybridmap.map_event": ("MapEvent", "MapEventKind"),
        "mapweave.hybridmap.mission_order": ("MissionKind", "MissionReport", "MissionState"),
        "mapweave.hybridmap.node": ("Edge", "EdgeKind", "Landmarks", "Node"),
        "mapweave.hybridmap.pose": ("Pose2", "PoseGaussian"),
        "mapweave.hybridmap.query": ("Certainty", "RelocalizeAnswer", "View"),
        "mapweave.map": ("Map",),
        "mapweave.mapserver.own_maps": ("maps_of",),
        "mapweave.mapserver.relocalization.relocalizer": ("Relocalizer",),
        "mapweave.node_table": ("NodeTable",),
        "mapweave.offline_merge": ("merge_map_files",),
        "mapweave.offline_relocalization": ("relocalizer_of",),
        "mapweave.storage.image_file": ("read_grey",),
        "mapweave.storage.map_file": ("MapFile", "read_map_file", "write_map_file"),
        "mapweave.view_features": ("view_of",),
    }
    _MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}
    __all__ = [*_MODULE_OF]

    def __getattr__(name):
        if name == "__version__":
            from importlib.metadata import version

            return version("mapweave")
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'mapweave' has no attribute {name!r}")
        try:
            return getattr(import_module(_MODULE_OF[name]), name)
        except ModuleNotFoundError as error:
            from mapweave.extras import MissingExtra, extra_of

            extra = extra_of(error.name)
            if extra is None:
                raise
            raise ImportError(f"mapweave.{name} {MissingExtra([extra])}") from error

    def __dir__():
        return [*__all__, "__version__"]
