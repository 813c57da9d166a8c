"""Flows: generators that yield what is to be done and receive its result, so that both clients share their logic."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Generator
from contextlib import closing
from typing import Any, TypeVar

T = TypeVar("T")
Operation = TypeVar("Operation")


def follow(flow: Generator[Operation, Any, T], perform: Callable[[Operation], Any]) -> T:
    """Performs the operations of a flow, whose result it returns. An error is raised where the flow yielded."""
    result: Any = None
    failure: Exception | None = None
    # An interrupted flow ends now, not when its traceback is freed.
    with closing(flow):
        while True:
            try:
                operation = flow.throw(failure) if failure else flow.send(result)
            except StopIteration as end:
                returned: T = end.value
                return returned
            result, failure = None, None
            try:
                result = perform(operation)
            except Exception as error:
                failure = error


async def follow_async(flow: Generator[Operation, Any, T], perform: Callable[[Operation], Awaitable[Any]]) -> T:
    """As :func:`follow`, with coroutines."""
    result: Any = None
    failure: Exception | None = None
    with closing(flow):
        while True:
            try:
                operation = flow.throw(failure) if failure else flow.send(result)
            except StopIteration as end:
                returned: T = end.value
                return returned
            result, failure = None, None
            try:
                result = await perform(operation)
            except Exception as error:
                failure = error
