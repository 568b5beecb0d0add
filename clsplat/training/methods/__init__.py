"""Parts of published systems that only their presets use. The training loop does not depend on a method's options."""
