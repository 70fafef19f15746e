"""From a recording's bytes to images and clouds: one reader a wire, one meaning for all."""
