"""What holds for all tests."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

# A machine may be slow and busy: how long an example takes says nothing.
settings.register_profile("ropetrace", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("ropetrace")
