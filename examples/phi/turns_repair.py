# A phi over turns for an agent that repairs programs, with the tools search, read_file, edit, run_tests and submit. Written by hand by
# the engineers of LaRe, who saw the description of the tools and five example turns: no language model wrote it.


def turn_events(tool, arguments, result, text):
    answer = result.lower()
    counts = {"failed": 0, "passed": 0}
    words = answer.replace(",", " ").split()
    for i in range(len(words) - 1):
        if words[i].isdigit() and words[i + 1] in counts:
            counts[words[i + 1]] = int(words[i])
    is_test = tool == "run_tests"
    is_edit = tool == "edit" and answer.startswith("edited")
    path = str(arguments.get("path", ""))
    return {
        "finds something": tool == "search" and "no match" not in answer and answer != "",
        "finds nothing": tool == "search" and "no match" in answer,
        "reads source": tool == "read_file" and "test" not in path and "error" not in answer[:20],
        "edits source": is_edit and "test" not in path,
        "edits tests": is_edit and "test" in path,
        "edit refused": tool == "edit" and not is_edit,
        "all tests pass": is_test and counts["passed"] > 0 and counts["failed"] == 0,
        "runs every test": is_test and path == "",
        "tests fail": is_test and counts["failed"] > 0,
        "failing tests": min(counts["failed"], 20) if is_test else 0,
        "tests cannot run": is_test and counts["passed"] + counts["failed"] == 0,
    }
