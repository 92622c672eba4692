// What native code and Python know of each other: plans, which Python lays down, and functions of either side and of CUDA's driver.
#pragma once
#include "c_library.h"
#include "xla_ffi.h"

typedef void (*Function)(const void* arguments);

enum Kind { ONCE, SHARED, CUDA, CUDA_BESIDE, CLEAR, HUGE_PAGES };  // ONCE: on the CPU, also among launches on CUDA

// In place of a CUDA device; SOON: a program is being made, most likely for the first device that the process uses.
static constexpr int ON_CPU = -1, CUDA_SOON = -2, CPU_SOON = -3;
static constexpr int MOST_ARRAYS = 48, MOST_BYTES = 1024, MOST_WORDS = 1024, MOST_RECORDED = 32, MOST_ASKED = 1024;
// How often the same addresses are met before launches are recorded, which takes much longer than they do: where the host would wait
// else, and where it would not.
static constexpr int OFTEN_TO_ASK = 2, OFTEN = 8;

struct Step {
    void* function;                  // CPU: called with the address of the arguments; CUDA: a function of the driver
    const unsigned char* arguments;  // their bytes
    const int* arrays;               // places among these bytes, each behind it the number of the array whose address belongs there
    int size, array_count;
    int kind;
    int block;          // CUDA: threads of a block
    long long threads;  // CPU: how many may share the work; CUDA: in all; of what is cleared or in huge pages: bytes
};
// Launches that were recorded for arrays at certain addresses: a graph of CUDA, or none yet where they were not met often.
struct Recorded {
    void* arrays[MOST_ARRAYS];
    int count, times;
    unsigned int met;  // the turn in which it was met last
    void* graph;
};
// What records launches on a device, where its driver has graphs that decide by themselves what runs.
struct Recorder {
    void *stream, *context;
    const Step* decide;  // of what is asked, the first step as one that lets a graph go on,
    int condition;       // and where among its arguments the condition stands
    Recorded recorded[MOST_RECORDED];
    unsigned int turn;
    int locked, fails;
};
struct Plan {
    const char* name;
    long long name_size;
    unsigned long long hash;
    long long users;  // calls that are under way
    const Step* steps;
    void *side, *begun, *ended;  // a second stream of the device, and two events; of those that take turns the last event alone
    int device, step_count;
    int in_turns;  // whether calls take turns, as they share what is kept on a device
    // The number of an array of so many words, -1 without: the first step writes it, and others are launched if a word is not 0.
    int asked, asked_words;
    Recorder* recorder;
};

// What Python tells once: functions that are called, and the plans there are.
struct Desk {
    // Asks Python for the plan of a name, and writes down what goes wrong, or an empty text.
    void (*make_plan)(const char* name, long long name_size, const char* recipe, long long recipe_size, int device, char* wrong);
    int (*yield)();
    int (*advise)(void* address, size_t size, int advice);
    int (*launch)(void* function, unsigned int, unsigned int, unsigned int, unsigned int, unsigned int, unsigned int, unsigned int,
        void* stream, void** arguments, void** extra);
    int (*clear)(unsigned long long address, unsigned int word, size_t words, void* stream);
    int (*record)(void* event, void* stream);
    int (*wait)(void* stream, void* event, unsigned int);
    int (*read)(void* host, unsigned long long address, size_t bytes, void* stream);
    int (*finish)(void* stream);
    // graphs
    int (*make_graph)(void** graph, unsigned int);
    int (*make_condition)(unsigned long long* condition, void* graph, void* context, unsigned int value, unsigned int flags);
    int (*begin_record)(void* stream, void* graph, const void*, const void*, size_t, int mode);
    int (*end_record)(void* stream, void** graph);
    int (*nodes_of)(void* graph, void** nodes, size_t* count);
    int (*add_node)(void** node, void* graph, void* const* behind, size_t count, void* parameters);
    int (*make_ready)(void** ready, void* graph, unsigned long long flags);
    int (*drop_graph)(void* graph);
    int (*run_graph)(void* ready, void* stream);
    int (*drop_ready)(void* ready);
    // of Python, all of them called without its lock
    int (*is_alive)();
    int (*has_lock)();
    unsigned long (*this_thread)();
    unsigned long (*start_thread)(void (*work)(void*), void* given);
    void* (*make_lock)();
    int (*take_lock)(void* lock, int wait);
    void (*give_lock)(void* lock);
    void (*free_lock)(void* lock);
    Plan** plans;
    long long plan_count;
    unsigned long main_thread;
    int locked, forking;
    int asking, closed;  // questions that are open, and whether there will be no more answers
    void* turn;          // a lock of calls that take turns
};
static Desk* desk;

struct Lock {
    int* const locked;  // none: nothing is locked
    explicit Lock(int* given) : locked(given) {
        while (locked && __atomic_exchange_n(locked, 1, __ATOMIC_ACQUIRE))
            desk->yield();
    }
    ~Lock() {
        if (locked)
            __atomic_store_n(locked, 0, __ATOMIC_RELEASE);
    }
};

static unsigned long long hash_of(const char* name, long long size) {
    unsigned long long hash = 0x9e3779b97f4a7c15ull + (unsigned long long)size, word;
    for (; size > 0; size -= 8, name += 8) {
        word = 0;
        memcpy(&word, name, size < 8 ? (size_t)size : 8);
        hash = (hash ^ word) * 0xff51afd7ed558ccdull;
        hash ^= hash >> 32;
    }
    return hash;
}
