"""Other people's methods for a photo of an unknown lens, re-implemented from their publications.

Each file has one: `estimate(image (H, W, 3) RGB uint8) -> FisheyeCamera | None`, None where it finds nothing to go by;
that of rong.py takes its network too.
"""
