"""Converse with an avatar: hear or read a message, get an answer, speak it sentence by sentence and move; no torch."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "ChatParts": "avatar.conversation.conversation",
    "Conversation": "avatar.conversation.conversation",
    "Endpoint": "avatar.conversation.answers",
    "FrameQueue": "avatar.conversation.frame_queue",
    "Line": "avatar.conversation.frame_queue",
    "Partner": "avatar.conversation.conversation",
    "Recognisers": "avatar.conversation.hearing",
    "RulePartner": "avatar.conversation.answers",
    "Turn": "avatar.conversation.conversation",
    "find_activity": "avatar.conversation.hearing",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.conversation", _EXPORTS)
