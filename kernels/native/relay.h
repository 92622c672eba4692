// --- part: relay

{
    struct Relay {
        using word = unsigned long long;
        using integer = decltype(0);  // `int` is a macro of Warp's
        using Answer = void* (*)(void*);
        using Thread = unsigned long (*)();
        using Acquire = integer (*)(void*, integer);
        using Release = void (*)(void*);
        static word*& desk() {
            static word* words = nullptr;
            return words;
        }
        static void* answer(void* frame) {
            word* words = desk();
            if (((Thread)words[THREAD])() != words[MAIN_THREAD])
                return ((Answer)words[ANSWER_HERE])(frame);
            words[FRAME] = (word)frame;
            ((Release)words[RELEASE])((void*)words[ASKED]);
            ((Acquire)words[ACQUIRE])((void*)words[ANSWERED], 1);
            return (void*)words[ANSWER];
        }
    };
    Relay::desk() = (unsigned long long*)words.data;
    address_out.data[0] = (unsigned long long)&Relay::answer;
}
