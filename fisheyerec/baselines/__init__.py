"""The methods that the paper is compared with, one file each: from a picture to its camera."""
