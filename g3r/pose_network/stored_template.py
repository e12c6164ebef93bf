"""The atlas template in the file of a pose network, read without the network."""

from __future__ import annotations

from typing import Any

import numpy as np

from g3r.acquisition.atlas_template import AtlasTemplate
from g3r.checkpoints.plain_values import config_from_plain, numbers
from g3r.checkpoints.stored_model import StoredModel
from g3r.pose_network.config import PoseNetworkConfig


def stored_template(pose: StoredModel[Any]) -> AtlasTemplate:
    """The template, from weights that ship with the package or have been loaded, and are therefore known to be valid.

    Args:
        pose: a stored pose network.
    """
    description = pose.file.description
    config = config_from_plain(PoseNetworkConfig, description["network_arguments"])
    volume = np.ascontiguousarray(np.moveaxis(pose.array("template"), -1, 0))
    return AtlasTemplate(volume, config.template_grid.affine, np.array(numbers(description, "weeks")))
