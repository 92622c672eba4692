// How a call of XLA becomes launches of kernels: native code on the thread of the call, which neither runs nor waits for Python, unless
// its plan is not known yet.
//
// Python lays down a plan for each kernel, for the shapes of a call and, on CUDA, for a device: which functions are launched, in order,
// and the bytes of their arguments, but for the addresses of arrays, which a call brings. Plans are found by the name that a program
// carries. A name that is not known yet, of a program that another process has traced, is asked of Python once.
#pragma once
#include "calls.h"

// Finds a plan, which stays until `leave`.
static Plan* enter(XLA_FFI_ByteSpan name, int device) {
    const unsigned long long hash = hash_of(name.ptr, (long long)name.len);
    const Lock lock(&desk->locked);
    for (long long k = 0; k < desk->plan_count; ++k) {
        Plan* plan = desk->plans[k];
        if (plan->hash != hash || plan->device != device || plan->name_size != (long long)name.len)
            continue;
        bool same = true;
        for (size_t l = 0; same && l < name.len; ++l)
            same = plan->name[l] == name.ptr[l];
        if (same) {
            __atomic_fetch_add(&plan->users, 1, __ATOMIC_RELAXED);
            return plan;
        }
    }
    return nullptr;
}
static void leave(Plan* plan) { __atomic_fetch_sub(&plan->users, 1, __ATOMIC_RELEASE); }

// A question to Python for a plan. Where nothing comes back, something went wrong.
struct Question {
    XLA_FFI_ByteSpan name, recipe;
    int device;
    char wrong[MOST_WORDS] = "Python ended, or stopped, before it had answered.";
    void* answered = nullptr;

    void ask() { desk->make_plan(name.ptr, (long long)name.len, recipe.ptr, (long long)recipe.len, device, wrong); }
    static void ask_apart(void* given) {
        Question* question = (Question*)given;
        question->ask();
        desk->give_lock(question->answered);
    }
    // Asks, on another thread where this is the main one: there Python runs handlers of signals, and what they raise would be raised
    // in the midst of the answer, and be lost. They run when this call has ended.
    bool succeeds() {
        const bool on_main = desk->this_thread() == desk->main_thread;
        __atomic_fetch_add(&desk->asking, 1, __ATOMIC_SEQ_CST);
        if (on_main || !__atomic_load_n(&desk->closed, __ATOMIC_SEQ_CST))
            wait(on_main && desk->is_alive() && !desk->has_lock());
        __atomic_fetch_sub(&desk->asking, 1, __ATOMIC_SEQ_CST);
        return wrong[0] == 0;
    }
    void wait(bool apart) {
        if (apart)
            answered = desk->make_lock();
        if (answered == nullptr)
            ask();
        else {
            desk->take_lock(answered, 1);
            if (desk->start_thread(ask_apart, this) == ~0ul)
                ask();
            else
                desk->take_lock(answered, 1);
            desk->give_lock(answered);
            desk->free_lock(answered);
        }
    }
    XLA_FFI_Error* fail(const Call& call) const {
        Message message;
        message.add_name(name);
        message.add(wrong);
        return call.fail(message.text);
    }
};

// A step of the CPU, which threads of XLA's pool may join until the thread of the call has found nothing left to do.
struct Team {
    static constexpr int CLOSED = 1 << 30;
    Function function;
    const void* arguments;
    int inside;   // threads that have joined and not left, and whether the step is CLOSED to others
    int holders;  // who has yet to let go of this memory

    static void release(Team* team) {
        if (__atomic_sub_fetch(&team->holders, 1, __ATOMIC_ACQ_REL) == 0)
            free(team);
    }
    static void join(void* data) {
        Team* team = (Team*)data;
        int inside = __atomic_load_n(&team->inside, __ATOMIC_RELAXED);
        while (!(inside & CLOSED))
            if (__atomic_compare_exchange_n(&team->inside, &inside, inside + 1, true, __ATOMIC_ACQUIRE, __ATOMIC_RELAXED)) {
                team->function(team->arguments);
                __atomic_fetch_sub(&team->inside, 1, __ATOMIC_RELEASE);
                break;
            }
        release(team);
    }
    static void run(const Call& call, Function function, const void* arguments, long long most) {
        const int threads = most > 1 ? call.thread_count() : 1, others = (int)(most < threads ? most : threads) - 1;
        Team* team = others > 0 ? (Team*)malloc(sizeof(Team)) : nullptr;
        if (team == nullptr) {
            function(arguments);
            return;
        }
        *team = Team{function, arguments, 0, others + 1};
        for (int k = 0; k < others; ++k)
            if (!call.schedule(join, team))
                release(team);
        function(arguments);
        int inside = __atomic_or_fetch(&team->inside, CLOSED, __ATOMIC_ACQUIRE);
        for (int spins = 0; inside != CLOSED; inside = __atomic_load_n(&team->inside, __ATOMIC_ACQUIRE))
            if (++spins > 64)
                desk->yield();
        release(team);
    }
};

// The turn of a call, where calls take turns.
struct Turn {
    const bool is_taken;
    explicit Turn(const Plan& plan) : is_taken(plan.in_turns) {
        if (is_taken)
            desk->take_lock(desk->turn, 1);
    }
    ~Turn() {
        if (is_taken)
            desk->give_lock(desk->turn);
    }
};

// What a call does on a device.
struct Work {
    const Call& call;
    const Plan& plan;
    void* const stream;
    void* arrays[MOST_ARRAYS + 1];  // behind them the stream
    const int count;
    const Turn turn;

    Work(const Call& given, const Plan& found, void* of_call)
        : call(given), plan(found), stream(of_call), count(given.arrays(arrays)), turn(found) {
        arrays[count] = stream;
    }

    void fill(const Step& step, unsigned char* bytes) const {
        memcpy(bytes, step.arguments, (size_t)step.size);
        for (int k = 0; k < step.array_count; ++k)
            memcpy(bytes + step.arrays[2 * k], &arrays[step.arrays[2 * k + 1]], sizeof(void*));
    }
    int launch(const Step& step, void* on, unsigned long long condition = 0) const {
        alignas(16) unsigned char bytes[MOST_BYTES];
        fill(step, bytes);
        if (condition)
            memcpy(bytes + plan.recorder->condition, &condition, sizeof(condition));
        void* arguments[1] = {bytes};
        const unsigned int blocks = (unsigned int)((step.threads + step.block - 1) / step.block);
        return blocks ? desk->launch(step.function, blocks, 1, 1, (unsigned int)step.block, 1, 1, 0, on, arguments, nullptr) : 0;
    }
    // Launches a step and the one behind it, which waits for what came before both alone. The second stream and its events are those
    // of all calls on a device.
    int launch_both(const Step* step, void* on) const {
        int wrong = desk->record(plan.begun, on);
        wrong = wrong ? wrong : desk->wait(plan.side, plan.begun, 0);
        wrong = wrong ? wrong : launch(step[0], on);
        wrong = wrong ? wrong : launch(step[1], plan.side);
        wrong = wrong ? wrong : desk->record(plan.ended, plan.side);
        return wrong ? wrong : desk->wait(on, plan.ended, 0);
    }
    void run_once(const Step& step) const {
        alignas(16) unsigned char bytes[MOST_BYTES];
        fill(step, bytes);
        ((Function)step.function)(bytes);
    }
    // Where arrays stand at addresses that were met lately, as in a loop, launches were recorded in a graph: one call of the driver then
    // takes less of the host than a launch does.
    int run_on_cuda() const {
        int wrong = 0;
        if (plan.recorder != nullptr && runs_recorded(*plan.recorder, wrong))
            return wrong;
        if (plan.asked >= 0)
            return run_if_asked();
        if (!plan.in_turns)
            return launch_all(0);
        wrong = desk->wait(stream, plan.ended, 0);  // for calls before, on other streams
        wrong = wrong ? wrong : launch_all(0);
        const int lost = desk->record(plan.ended, stream);
        return wrong ? wrong : lost;
    }
    int launch_all(int first) const {
        const Lock lock(plan.side ? &desk->forking : nullptr);
        return launch_steps(first, stream);
    }
    int launch_steps(int first, void* on) const {
        int wrong = 0;
        for (int k = first; k < plan.step_count && !wrong; ++k) {
            const bool forks = k + 1 < plan.step_count && plan.steps[k + 1].kind == CUDA_BESIDE;
            wrong = forks ? launch_both(plan.steps + k++, on) : begin(plan.steps[k], on);
        }
        return wrong;
    }
    int begin(const Step& step, void* on) const {
        if (step.kind == CLEAR)
            return desk->clear((unsigned long long)arrays[step.arrays[1]], 0, (size_t)step.threads / 4, on);
        if (step.kind != ONCE)
            return launch(step, on);
        run_once(step);
        return 0;
    }
    // The first step, and the others if they are asked for: the host reads whether they are, and waits. Where launches are recorded, the
    // device decides.
    int run_if_asked() const {
        int words[MOST_ASKED], asked = 0;
        int wrong = begin(plan.steps[0], stream);
        wrong = wrong ? wrong : desk->read(words, (unsigned long long)arrays[plan.asked], (size_t)plan.asked_words * 4, stream);
        wrong = wrong ? wrong : desk->finish(stream);
        for (int k = 0; k < plan.asked_words && !wrong; ++k)
            asked |= words[k];
        return wrong || !asked ? wrong : launch_all(1);
    }
    bool runs_recorded(Recorder& recorder, int& wrong) const {
        const Lock lock(&recorder.locked);
        Recorded* oldest = recorder.recorded;
        ++recorder.turn;
        for (Recorded& each : recorder.recorded) {
            bool same = each.count == count;
            for (int k = 0; same && k < count; ++k)
                same = each.arrays[k] == arrays[k];
            if (same) {
                each.met = recorder.turn;
                if (each.graph == nullptr && !recorder.fails && ++each.times >= (plan.asked >= 0 ? OFTEN_TO_ASK : OFTEN)) {
                    each.graph = record(recorder);
                    recorder.fails = each.graph == nullptr;
                }
                wrong = each.graph == nullptr ? 0 : desk->run_graph(each.graph, stream);
                return each.graph != nullptr;
            }
            if (each.met - recorder.turn < oldest->met - recorder.turn)
                oldest = &each;
        }
        if (oldest->graph != nullptr)
            desk->drop_ready(oldest->graph);
        oldest->graph = nullptr;
        oldest->count = count;
        oldest->times = 1;
        oldest->met = recorder.turn;
        memcpy(oldest->arrays, arrays, (size_t)count * sizeof(void*));
        return false;
    }
    // Returns a graph of all steps, those that are asked for behind a condition; none where the driver cannot make it.
    void* record(const Recorder& recorder) const {
        void *graph = nullptr, *ready = nullptr;
        const Lock lock(&desk->forking);  // these streams are those of all calls on a device
        if (desk->make_graph(&graph, 0))
            return nullptr;
        const int wrong = plan.asked >= 0 ? record_if_asked(recorder, graph)
                                          : record_into(graph, recorder.stream, [&] { return launch_steps(0, recorder.stream); });
        if (wrong || desk->make_ready(&ready, graph, 0))
            ready = nullptr;
        desk->drop_graph(graph);
        return ready;
    }
    template <class Launches>
    int record_into(void* graph, void* on, Launches launches) const {
        int wrong = desk->begin_record(on, graph, nullptr, nullptr, 0, 2);
        if (wrong)
            return wrong;
        wrong = launches();
        const int lost = desk->end_record(on, &graph);
        return wrong ? wrong : lost;
    }
    int record_if_asked(const Recorder& recorder, void* graph) const {
        // CUgraphNodeParams of a conditional node
        struct Condition {
            int type = 13, reserved[3] = {};
            unsigned long long condition = 0;
            int kind = 0;  // if
            unsigned int size = 1;
            void** bodies = nullptr;
            void* context = nullptr;
            long long rest[26] = {};
        } node;
        static_assert(sizeof(Condition) == 256, "CUgraphNodeParams");
        node.context = recorder.context;
        int wrong = desk->make_condition(&node.condition, graph, recorder.context, 0, 1);
        void *before[4], *conditional = nullptr;
        size_t count_before = 4;
        auto ask = [&] { return launch(*recorder.decide, recorder.stream, node.condition); };
        wrong = wrong ? wrong : record_into(graph, recorder.stream, ask);
        wrong = wrong ? wrong : desk->nodes_of(graph, before, &count_before);
        wrong = wrong ? wrong : desk->add_node(&conditional, graph, before, count_before, &node);
        return wrong ? wrong : record_into(node.bodies[0], recorder.stream, [&] { return launch_steps(1, recorder.stream); });
    }
    void run_on_cpu() const {
        alignas(16) unsigned char bytes[MOST_BYTES];
        for (int k = 0; k < plan.step_count; ++k) {
            const Step& step = plan.steps[k];
            void* array = step.array_count ? arrays[step.arrays[1]] : nullptr;
            if (step.kind == CLEAR)
                memset(array, 0, (size_t)step.threads);
            else if (step.kind == HUGE_PAGES)
                ask_for_huge_pages(array, step.threads);
            else {
                fill(step, bytes);
                Team::run(call, (Function)step.function, bytes, step.kind == SHARED ? step.threads : 1);
            }
        }
    }
    // Lets Linux back a large array with huge pages: its first touch then costs a few faults instead of one per 4 KiB.
    static void ask_for_huge_pages(void* address, long long size) {
        constexpr unsigned long long PAGE = 4096;
        const unsigned long long begin = ((unsigned long long)address + PAGE - 1) / PAGE * PAGE;
        const unsigned long long end = ((unsigned long long)address + (unsigned long long)size) / PAGE * PAGE;
        if (desk->advise && end > begin)
            desk->advise((void*)begin, end - begin, 14);
    }
};

static XLA_FFI_Error* answer(XLA_FFI_CallFrame* frame, bool cuda) {
    const Call call(frame);
    for (auto* extension = frame->extension_start; extension; extension = extension->next)
        if ((int)extension->type == 1) {  // a question for the version of the interface, whatever the header calls it
            XLA_FFI_Metadata* asked = ((XLA_FFI_Metadata_Extension*)extension)->metadata;
            asked->api_version.major_version = XLA_FFI_API_MAJOR;
            asked->api_version.minor_version = XLA_FFI_API_MINOR;
            return nullptr;
        }
    const bool executes = frame->stage == XLA_FFI_ExecutionStage_EXECUTE;
    if (!executes && frame->stage != XLA_FFI_ExecutionStage_INSTANTIATE)
        return nullptr;
    const XLA_FFI_ByteSpan name = call.text("kernel");
    if (!executes) {  // XLA does not say for which device a program is made
        Question question = {name, call.text("recipe"), cuda ? CUDA_SOON : CPU_SOON};
        return question.succeeds() ? nullptr : question.fail(call);
    }
    const int device = cuda ? call.device() : ON_CPU;
    Plan* plan = enter(name, device);
    while (plan == nullptr) {
        Question question = {name, call.text("recipe"), device};
        if (!question.succeeds())
            return question.fail(call);
        plan = enter(name, device);
    }
    XLA_FFI_Error* error = nullptr;
    if (cuda) {
        const int wrong = Work(call, *plan, call.stream()).run_on_cuda();
        error = wrong ? call.fail_at("a launch failed with CUDA's error ", wrong) : nullptr;
    } else
        Work(call, *plan, nullptr).run_on_cpu();
    leave(plan);
    return error;
}

// --- what Python calls ---

extern "C" {
// Takes the desk, where both sides mean the same by what stands on it.
bool open_desk(Desk* given, long long desk_size, long long plan_size, long long step_size) {
    desk = given;
    desk->turn = desk->make_lock();
    return desk_size == sizeof(Desk) && plan_size == sizeof(Plan) && step_size == sizeof(Step);
}
XLA_FFI_Error* answer_on_cpu(XLA_FFI_CallFrame* frame) { return answer(frame, false); }
XLA_FFI_Error* answer_on_cuda(XLA_FFI_CallFrame* frame) { return answer(frame, true); }
// Forgets what threads were at that a process which has begun by a fork does not have.
void begin_anew(unsigned long main_thread) {
    desk->main_thread = main_thread;
    desk->locked = desk->forking = desk->asking = 0;
    desk->turn = desk->make_lock();
    for (long long k = 0; k < desk->plan_count; ++k)
        desk->plans[k]->users = 0;
}
// Waits for all answers, and lets other threads than the main one ask no more: at its end, Python does not come back to them.
void close_desk() {
    __atomic_store_n(&desk->closed, 1, __ATOMIC_SEQ_CST);
    while (__atomic_load_n(&desk->asking, __ATOMIC_SEQ_CST) > 0)
        desk->yield();
}
void keep_plan(Plan* plan) {
    plan->hash = hash_of(plan->name, plan->name_size);
    const Lock lock(&desk->locked);
    desk->plans[desk->plan_count++] = plan;
}
// Lets nobody find a plan any longer, and waits for those who have.
void drop_plan(Plan* plan) {
    {
        const Lock lock(&desk->locked);
        for (long long k = 0; k < desk->plan_count; ++k)
            if (desk->plans[k] == plan)
                desk->plans[k--] = desk->plans[--desk->plan_count];
    }
    while (__atomic_load_n(&plan->users, __ATOMIC_ACQUIRE))
        desk->yield();
    if (plan->recorder)
        for (Recorded& each : plan->recorder->recorded)
            if (each.graph)
                desk->drop_ready(each.graph);
}
}
