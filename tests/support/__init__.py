"""What tests compare with, and the systems, runs and figures that several share."""
