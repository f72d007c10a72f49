"""Rules and policies, by the name that servers use; they are values of `busway.config.access`."""

from ...config.access.question import Asker, Piece, Question
from ...config.access.rules import Access, AccessRules, Action, Decision, Limits, Policy, Rule

__all__ = ["Access", "AccessRules", "Action", "Asker", "Decision", "Limits", "Piece", "Policy", "Question", "Rule"]
