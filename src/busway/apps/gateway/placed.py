"""A route of a gateway file, with where it stands: so that a sentence about it can name upstream and key.

Knows sections and routes; judges nothing.
"""

from dataclasses import dataclass

from ...config.files.gateway import RouteSection
from ...config.files.lines import Path as Place
from .routes import Route


@dataclass(frozen=True, slots=True)
class PlacedRoute:
    """A route, and where it stands; ``section`` is None for the one of a file without routes."""

    route: Route
    place: Place
    section: RouteSection | None

    @property
    def title(self) -> str:
        """How sentences call it."""
        return f"{self.place[0]}[{self.place[1]}]" + (f" ({self.route.name})" if self.route.name else "")

    @property
    def gap(self) -> float:
        """Seconds that its unit is left alone after it has replied."""
        return (self.section.request_gap or 0.0) if self.section is not None else 0.0

    def key(self, *names: str) -> Place:
        """Where the first of these keys stands that is set, or else the route itself."""
        written = set() if self.section is None else self.section.model_fields_set
        return next(((*self.place, name) for name in names if name in written), self.place)
