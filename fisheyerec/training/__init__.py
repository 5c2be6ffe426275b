"""Making pairs of fisheye and straight pictures, training on them, and judging methods by them."""
