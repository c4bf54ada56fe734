"""The harness itself: messages arrive, exceptions fail the test, domains keep tests apart."""

import pytest
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger


def test_mailbox_and_publish(graph):
    echo = Node("echo", context=graph.context)
    publisher = echo.create_publisher(String, "out", 10)
    echo.create_subscription(String, "in", lambda message: publisher.publish(String(data=message.data * 2)), 10)
    graph.add(echo)
    box = graph.mailbox(String, "out")
    graph.spin_until(lambda: publisher.get_subscription_count() == 1)
    graph.publish("in", String(data="ab"))
    graph.spin_until_filled([box])
    assert [message.data for message in box] == ["abab"]


def test_latched_message_arrives_late(graph):
    graph.publish("once", String(data="kept"), latched=True, subscribers=0)
    box = graph.mailbox(String, "once", latched=True)
    graph.spin_until_filled([box])
    assert box[0].data == "kept"


def test_callback_exception_fails_the_test(graph):
    broken = Node("broken", context=graph.context)

    def fail(message):
        raise ZeroDivisionError(message.data)

    broken.create_subscription(String, "in", fail, 10)
    graph.add(broken)
    graph.publish("in", String(data="now"))
    with pytest.raises(ZeroDivisionError, match="now"):
        graph.spin_for(5.0)


def test_service_call(graph):
    server = Node("server", context=graph.context)

    def answer(request, response):
        response.success, response.message = True, "done"
        return response

    server.create_service(Trigger, "act", answer)
    graph.add(server)
    response = graph.call(Trigger, "act")
    assert (response.success, response.message) == (True, "done")


def test_timeout_says_what_was_waited_for(graph):
    with pytest.raises(AssertionError, match="in vain for nothing"):
        graph.spin_until(lambda: False, timeout=0.1, what="nothing")
