"""Where simulation and measurement disagree, which effect is missing, and what is left once it is added."""
