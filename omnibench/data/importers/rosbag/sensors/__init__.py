"""References of sensors in the place of poses: satellite fixes, and headings of compasses and gyros."""
