"""Free: a scene without a task."""
