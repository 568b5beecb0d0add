"""Images against photographs."""
