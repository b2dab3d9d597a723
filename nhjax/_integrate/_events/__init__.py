"""Events of a run: their functions, the search for zeros, the stepper and the log."""

from ._event import checked_events as checked_events, Event as Event
from ._stepper import EventStepper as EventStepper
