"""Driving scenes under the simple prior: 0 to 2 of everything, whatever the scenario (Meta-Sim2, supplement)."""

from .driving import SIMPLE

SCENARIOS = SIMPLE
