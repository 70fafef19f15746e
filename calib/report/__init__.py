"""What a calibration shows of itself: pictures, a page, a few lines of text, the tables in rig.toml."""
