"""Views prepared for tracking: local planes, albedo, noise."""
