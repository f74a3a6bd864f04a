"""A map in 3D, in Rerun: live, or as a recording that Rerun opens later."""
