"""The road network of a Waymo record as a SUMO net.xml."""

from sumo_adv.womd.network.convert import ConvertedNetwork, convert_network
from sumo_adv.womd.network.pieces import Piece

__all__ = ["ConvertedNetwork", "Piece", "convert_network"]
