"""Free: a scene without a task, without reward and success. What happens in it belongs to its user."""
