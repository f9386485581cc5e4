# A phi over turns for an agent that serves customers of a shop, with the tools find_customer, get_order, get_variants, cancel_order,
# return_items, exchange_item and transfer. Written by hand by the engineers of LaRe, who saw the description of the tools and five
# example turns: no language model wrote it.


def turn_events(tool, arguments, result, text):
    answer, words = result.lower(), text.lower()
    changes = tool in ("cancel_order", "return_items", "exchange_item")
    refused = answer.startswith("error")
    agreed = tool == "" and any(
        answer.strip().startswith(yes) for yes in ("yes", "ok", "sure", "please do", "that is fine")
    )
    is_question = tool == "" and "?" in words
    return {
        "customer found": tool == "find_customer" and "customer_id" in answer,
        "customer not found": tool == "find_customer" and "customer_id" not in answer,
        "order is pending": tool == "get_order" and '"pending"' in answer,
        "order is delivered": tool == "get_order" and '"delivered"' in answer,
        "variant available": tool == "get_variants" and '"available": true' in answer,
        "nothing available": tool == "get_variants" and '"available": true' not in answer,
        "asks for consent": is_question
        and any(word in words for word in ("shall i", "would you like", "confirm", "do you want")),
        "customer agrees": agreed,
        "customer objects": tool == "" and answer.strip().startswith("no"),
        "change made": changes and not refused,
        "change refused": changes and refused,
        "handed over": tool == "transfer",
    }
