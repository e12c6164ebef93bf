"""Conversion from DICOM to stacks, and from a volume to DICOM: series are listed, chosen, converted and written."""
