"""``evaluate=RUN``: testing a trained run with other sizes, other data or another task net."""
