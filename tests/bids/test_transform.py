"""The ITK transform file from the scanner to the volume's space, read by ITK."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import SimpleITK

from g3r.bids.transform import itk_text
from g3r.geometry.rigid import rotation_matrix


def test_itk_maps_points_of_the_standard_space_to_the_scanner(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix([0.4, -1.1, 0.7]), [31.0, -12.5, 8.25]
    path = tmp_path / "a_from-scanner_to-standard_mode-image_xfm.txt"
    path.write_text(itk_text(matrix.tolist()))
    read = SimpleITK.ReadTransform(str(path))
    lps = np.array([-1.0, -1.0, 1.0])
    for scanner in rng.uniform(-100, 100, (20, 3)):
        standard = matrix[:3, :3] @ scanner + matrix[:3, 3]
        found = np.array(read.TransformPoint((standard * lps).tolist())) * lps
        np.testing.assert_allclose(found, scanner, atol=1e-7)


def test_resampling_by_itk_shows_a_scanned_point_where_it_stands_in_the_standard_space(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = [6.0, -4.0, 2.0]
    (tmp_path / "xfm.txt").write_text(itk_text(matrix.tolist()))
    scanned = SimpleITK.Image(21, 21, 21, SimpleITK.sitkFloat32)  # index 0 at LPS 0, 1 mm
    scanned[10, 10, 10] = 1.0  # at RAS (-10, -10, 10)
    moved = SimpleITK.Resample(scanned, scanned, SimpleITK.ReadTransform(str(tmp_path / "xfm.txt")))
    # at RAS (-4, -14, 12), which is LPS (4, 14, 12)
    assert moved[4, 14, 12] == 1.0
