"""Input stacks and the model of their acquisition, in the order of the data.

1. `nifti`, `images`, `header_text`, `sidecar` read files and check them; `slice_profile` decides thickness and PSF;
   `stacks` makes a `Stack` of an image and its mask.
2. `slicing` cuts stacks into `planes.Slices`, cropped to the mask and normalised.
3. `psf` is the slice profile; `voxel_operator` applies it: pixels of a volume (G3R Eq. 2), and the adjoint.
4. `bounding_grid` and `coarse_volume` give the volume of posed slices and their coverage (Eq. 6),
   `least_squares` a sharper volume, `foreground` the brain mask.

`robust` and `bias_basis` are shared by registration and fitting, `interleave` orders slices in time,
`atlas_template` holds heads in the atlas frame, `slice_images` is the input of the pose network.
"""
