"""From what stands or moves to photoelectrons and clicks."""
