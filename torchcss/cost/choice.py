"""Which terms make up the cost, and how they weigh; the table of all terms by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import field, replace
from typing import TypeVar

from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.contour import ContourTerm
from torchcss.cost.edge_energy import EdgeEnergyTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm
from torchcss.cost.pose_prior import PosePrior
from torchcss.cost.region import RegionTerm
from torchcss.cost.segmentation import SegmentationTerm
from torchcss.cost.silhouette import SilhouetteTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.term import Need, Term
from torchcss.types import Curvature, frozen

_Term = TypeVar("_Term", bound=Term)

TERM_TABLE: dict[str, type[Term]] = {
    "contour": ContourTerm,
    "edge_energy": EdgeEnergyTerm,
    "region": RegionTerm,
    "silhouette": SilhouetteTerm,
    "flow": FlowTerm,
    "joints": JointTerm,
    "stabiliser": Stabiliser,
    "anthropometric": Anthropometric,
    "pose_prior": PosePrior,
    "temporal": TemporalPrior,
    "temporal_mixture": MixturePrior,
    "interpenetration": Interpenetration,
    "segmentation": SegmentationTerm,
}
"""All terms by name, in the order in which costs are summed."""


@frozen
class CostChoice:
    """Which terms and priors make up the cost, and how they weigh.

    A term that lacks what it compares with (a frame without keypoints or flow, a body without free
    lengths) is silent.

    Attributes:
        terms: The terms, each of another name; image terms hold the temperature of their cost.
        weights: Further factors by the name of a term, one where none is given: what
            `torchcss.inference.implicit` learns.
        curvature: Which Hessian the optimiser gets.
    """

    terms: tuple[Term, ...] = (
        ContourTerm(),
        JointTerm(),
        Stabiliser(),
        Anthropometric(),
        TemporalPrior(),
    )
    weights: Mapping[str, float] = field(default_factory=dict)
    curvature: Curvature = Curvature.EXACT

    @property
    def needs(self) -> frozenset[Need]:
        """What the pictures have to be prepared for."""
        return frozenset().union(*(term.needs for term in self.terms))

    @property
    def whole_picture(self) -> bool:
        """Whether it matters what is seen far from the body: where the background is learnt."""
        return "background" in self.needs

    def weight(self, name: str) -> float:
        """The further factor on a term."""
        return self.weights.get(name, 1.0)

    def find(self, kind: type[_Term]) -> _Term:
        """The term of a class, which is among them."""
        return next(term for term in self.terms if isinstance(term, kind))

    def having(self, *terms: Term) -> CostChoice:
        """The same with some terms in place of those of their names, or besides."""
        new = {term.name: term for term in terms}
        kept = tuple(new.pop(term.name, term) for term in self.terms)
        return replace(self, terms=(*kept, *new.values()))

    def without(self, *names: str) -> CostChoice:
        """The same without some terms."""
        return replace(self, terms=tuple(t for t in self.terms if t.name not in names))

    def only(self, names: Collection[str]) -> CostChoice:
        """The same with some terms alone."""
        return replace(self, terms=tuple(t for t in self.terms if t.name in names))
