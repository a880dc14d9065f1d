"""`python -m refract_core.cli`."""

from . import main

main()
