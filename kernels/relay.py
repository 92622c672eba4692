"""A native function that lets another thread answer what arrives on Python's main thread, which waits outside Python meanwhile.

Python runs the handlers of signals on its main thread, between any two of its instructions. XLA calls from whatever thread it runs
a program on, the main thread included: there, a handler that raises would end a call at any point.
"""

import warp as wp

# Places in the array of words that is given: addresses of functions and locks, and numbers.
ANSWER_HERE, THREAD, MAIN_THREAD, ACQUIRE, RELEASE, ASKED, ANSWERED, FRAME, ANSWER = range(9)
WORDS = 9

_TEXT = f"""
{{
    struct Relay {{
        using word = unsigned long long;
        using integer = decltype(0);  // `int` is a macro of Warp's
        using Answer = void* (*)(void*);
        using Thread = unsigned long (*)();
        using Acquire = integer (*)(void*, integer);
        using Release = void (*)(void*);
        static word*& desk() {{
            static word* words = nullptr;
            return words;
        }}
        static void* answer(void* frame) {{
            word* words = desk();
            if (((Thread)words[{THREAD}])() != words[{MAIN_THREAD}])
                return ((Answer)words[{ANSWER_HERE}])(frame);
            words[{FRAME}] = (word)frame;
            ((Release)words[{RELEASE}])((void*)words[{ASKED}]);
            ((Acquire)words[{ACQUIRE}])((void*)words[{ANSWERED}], 1);
            return (void*)words[{ANSWER}];
        }}
    }};
    Relay::desk() = (unsigned long long*)words.data;
    address_out.data[0] = (unsigned long long)&Relay::answer;
}}
"""

_Words = wp.array(dtype=wp.uint64)


@wp.func_native(_TEXT)
def _open_native(words: _Words, address_out: _Words): ...


@wp.kernel(enable_backward=False)
def open_relay(words: _Words, address_out: _Words):
    """Tell the address of the relay that reads these words, which stay where they are. Launched with dim = 1 on the CPU."""
    _open_native(words, address_out)
