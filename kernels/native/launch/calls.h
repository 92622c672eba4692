// A call of XLA: what it brings, what it may ask for, and how it fails.
#pragma once
#include "desk.h"

// A message, for XLA to raise.
struct Message {
    char text[2 * MOST_WORDS];
    int size = 0;
    void add(const char* words, long long most = 1 << 20) {
        for (; *words && most > 0 && size < (int)sizeof(text) - 1; --most)
            text[size++] = *words++;
        text[size] = 0;
    }
    void add_number(int number) {
        char digits[12];
        int at = 11;
        digits[at] = 0;
        for (unsigned int rest = number < 0 ? 0u - number : number; at == 11 || rest; rest /= 10)
            digits[--at] = (char)('0' + rest % 10);
        if (number < 0)
            digits[--at] = '-';
        add(digits + at);
    }
    // Adds the name of a kernel, which ends where the sources it was made of are named.
    void add_name(XLA_FFI_ByteSpan name) {
        long long size = 0;
        while (size < (long long)name.len && name.ptr[size] != '@')
            ++size;
        add(name.ptr, size);
        add(": ");
    }
};

struct Call {
    XLA_FFI_CallFrame* const frame;
    explicit Call(XLA_FFI_CallFrame* given) : frame(given) {}

    XLA_FFI_Error* fail(const char* words) const {
        XLA_FFI_Error_Create_Args given = {sizeof(given), nullptr, words, XLA_FFI_Error_Code_INTERNAL};
        return frame->api->XLA_FFI_Error_Create(&given);
    }
    XLA_FFI_Error* fail_at(const char* words, int number) const {
        Message message;
        message.add_name(text("kernel"));
        message.add(words);
        message.add_number(number);
        return fail(message.text);
    }
    XLA_FFI_ByteSpan text(const char* name) const {
        const XLA_FFI_Attrs& given = frame->attrs;
        for (long long k = 0; k < given.size; ++k) {
            const XLA_FFI_ByteSpan* here = given.names[k];
            size_t l = 0;
            while (l < here->len && name[l] == here->ptr[l])
                ++l;
            if (l == here->len && name[l] == 0)
                return *(const XLA_FFI_ByteSpan*)given.attrs[k];
        }
        return XLA_FFI_ByteSpan{"", 0};
    }
    void discard(XLA_FFI_Error* error) const {
        XLA_FFI_Error_Destroy_Args given = {sizeof(given), nullptr, error};
        frame->api->XLA_FFI_Error_Destroy(&given);
    }
    int device() const {
        XLA_FFI_DeviceOrdinal_Get_Args given = {sizeof(given), nullptr, frame->ctx, 0};
        XLA_FFI_Error* error = frame->api->XLA_FFI_DeviceOrdinal_Get(&given);
        if (error)
            discard(error);
        return given.device_ordinal;
    }
    void* stream() const {
        XLA_FFI_Stream_Get_Args given = {sizeof(given), nullptr, frame->ctx, nullptr};
        XLA_FFI_Error* error = frame->api->XLA_FFI_Stream_Get(&given);
        if (error)
            discard(error);
        return given.stream;
    }
    int thread_count() const {
        int64_t count = 1;
        XLA_FFI_ThreadPool_NumThreads_Args given = {sizeof(given), nullptr, frame->ctx, &count};
        XLA_FFI_Error* error = frame->api->XLA_FFI_ThreadPool_NumThreads(&given);
        if (error) {
            discard(error);
            return 1;
        }
        return (int)count;
    }
    bool schedule(XLA_FFI_Task* task, void* data) const {
        XLA_FFI_ThreadPool_Schedule_Args given = {sizeof(given), nullptr, frame->ctx, task, data};
        XLA_FFI_Error* error = frame->api->XLA_FFI_ThreadPool_Schedule(&given);
        if (error)
            discard(error);
        return error == nullptr;
    }
    // Puts down the addresses of the arrays, inputs first, and returns how many there are.
    int arrays(void** found) const {
        int count = 0;
        for (long long k = 0; k < frame->args.size && count < MOST_ARRAYS; ++k)
            found[count++] = ((XLA_FFI_Buffer*)frame->args.args[k])->data;
        for (long long k = 0; k < frame->rets.size && count < MOST_ARRAYS; ++k)
            found[count++] = ((XLA_FFI_Buffer*)frame->rets.rets[k])->data;
        return count;
    }
};
